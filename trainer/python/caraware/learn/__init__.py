"""The learner: proximal policy optimisation, its networks, and what makes it fast."""
