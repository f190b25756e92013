"""The studio: a page in the browser to animate a face and to place its muscles."""
