"""The forward simulation: from a specification to a scene to an observation."""
