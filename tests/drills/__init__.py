"""Drills: the promises of the service put to the test with real processes and real signals.

Each drill starts a service of its own in a temporary folder, does to it what its name says, measures, and leaves no
process behind. ``python -m tests.drills list`` names them; a drill whose claim does not hold ends with exit code 1.
"""
