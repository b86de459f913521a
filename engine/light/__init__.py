"""Surface brightness: the Sersic profile and its integration over pixels, lensed or not."""
