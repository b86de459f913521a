"""What a modeller does before the inversion: find the AGN images, and fit AGN, deflector and host together.

Nothing here knows the truth: it sees an observation and how many AGN images there are.
"""
