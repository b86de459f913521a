"""One image by several codes: the same model, priors and noise, drawn by each code's own lensing and light.

What differs between the answers is then the codes'. Theirs are no dependencies of hostlens.
"""
