"""What light becomes in an observation: through its exposures where they are known, through its PSF stamp otherwise."""
