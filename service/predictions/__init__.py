"""Predictions of bias and scatter: the runs that they are made from, and the answer."""
