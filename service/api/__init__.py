"""The HTTP API: stateless, so that any number of processes may serve it."""
