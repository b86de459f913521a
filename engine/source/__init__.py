"""The source plane: grid, expected brightness, regularisation, and the matrix that lenses a source."""
