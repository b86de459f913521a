"""Figures of what is stored: which results they show, and how they are drawn and kept."""
