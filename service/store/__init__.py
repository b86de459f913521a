"""The store: the database is the only truth of the service, and this package the only one that speaks SQL.

Methods take and return typed models and are one transaction each; their docstrings say why.
"""
