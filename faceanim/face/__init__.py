"""The person: a head's skin, skull, muscles and parts, and how they become a body."""
