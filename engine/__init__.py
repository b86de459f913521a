"""The engine of hostlens: one realization in, one result out; pure functions on arrays and frozen dataclasses.

This module is the engine's public face: everything that ``service`` or a user may import.
"""
