"""Results as a VOTable 1.4, its rows in the binary form that says of every value whether it is there (BINARY2)."""

from __future__ import annotations

import binascii
import io
import re
from collections.abc import Iterable
from typing import BinaryIO

from service.exports.contents import Contents, Rows, Width
from service.exports.records import Encode, missing, record_type, records
from service.exports.template import empty_table, flat_provenance

_MARK = "<!--rows-->"
_DESCRIPTION = re.compile(r"<DESCRIPTION>.*?</DESCRIPTION>", re.DOTALL)


def write_votable(pieces: Iterable[Rows], contents: Contents, sink: BinaryIO) -> None:
    """One resource with one table; what is known of all rows stands as INFO before them."""
    head, tail = document(contents, f'<DATA><BINARY2><STREAM encoding="base64">{_MARK}</STREAM></BINARY2></DATA>')
    sink.write(head.encode())
    bits = (len(contents.columns) + 7) // 8
    octets = {name: _octets(width) for name, width in contents.widths.items()}
    kind = record_type(contents, octets, bits)
    encode = {name: _encoder(width) for name, width in contents.widths.items()}
    rest = b""
    for piece in pieces:
        found = records(piece, contents, kind, encode)
        found[kind.names[0]] = missing(piece)  # type: ignore[index]
        data = rest + found.tobytes()
        whole = len(data) // 3 * 3
        sink.write(binascii.b2a_base64(data[:whole]))
        rest = data[whole:]
    sink.write(binascii.b2a_base64(rest))
    sink.write(tail.encode())


def document(contents: Contents, data: str) -> tuple[str, str]:
    """The XML before and after the rows, where ``data`` is the element that holds or names them."""
    from astropy.io.votable import from_table  # noqa: PLC0415 - takes a while, as below
    from astropy.io.votable.tree import Info  # noqa: PLC0415

    file = from_table(empty_table(contents, {}))
    resource = file.resources[0]
    for name, value in flat_provenance(contents).items():
        resource.infos.append(Info(name=name, value=value))
    table = resource.tables[0]
    for field in table.fields:
        if field.name in contents.widths:
            width = contents.widths[field.name]
            field.datatype = "char" if width.is_ascii else "unicodeChar"
            field.arraysize = str(width.octets)
    text = io.BytesIO()
    file.to_xml(text)
    # Its writer breaks lines, which readers take for part of a description.
    unbroken = _DESCRIPTION.sub(
        lambda found: " ".join(found[0].split()).replace("> ", ">").replace(" <", "<"), text.getvalue().decode()
    )
    before, _, after = unbroken.partition("</TABLE>")
    before = before.partition("<DATA>")[0]
    head, _, tail = f"{before}{data}\n</TABLE>{after}".partition(_MARK)
    return head, tail


def _octets(width: Width) -> int:
    return width.characters if width.is_ascii else 2 * width.octets


def _encoder(width: Width) -> Encode:
    # No character needs more 16-bit units than it has octets in UTF-8.
    coding = "ascii" if width.is_ascii else "utf-16-be"
    return lambda text: text.encode(coding)
