"""Every way to animate a scene, measured: error against cost, and the cheapest that is good enough."""
