"""A certificate authority for one test, and a certificate of it that scheduler, workers and dispatcher share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import trustme


@dataclass(frozen=True)
class Certificates:
    """PEM files."""

    ca: Path
    cert: Path
    key: Path


def make_certificates(folder: Path) -> Certificates:
    authority = trustme.CA()
    own = authority.issue_cert("localhost")
    found = Certificates(folder / "ca.pem", folder / "cert.pem", folder / "key.pem")
    authority.cert_pem.write_to_path(found.ca)
    own.cert_chain_pems[0].write_to_path(found.cert)
    own.private_key_pem.write_to_path(found.key)
    return found
