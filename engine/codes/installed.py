"""Which other codes there are, and whether they can be imported here."""

from importlib.util import find_spec

PEERS = {"lenstronomy": "lenstronomy", "PyAutoLens": "autolens"}
"""Names, and the modules that they are imported by."""


def installed(peer: str) -> bool:
    """Whether a peer can be imported here."""
    return find_spec(PEERS[peer]) is not None
