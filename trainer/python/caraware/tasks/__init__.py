"""The tasks: what the policy's actions mean, when they are drawn, what they earn and what is measured of them."""
