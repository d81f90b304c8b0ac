"""Headers of tars that nobody vouches for."""

from __future__ import annotations

import tarfile

LARGEST_EXTENSION = 2**16
"""Bytes of an extended header: a long name, PAX attributes; our own shards have none."""
_EXTENSIONS = {
    tarfile.GNUTYPE_LONGNAME,
    tarfile.GNUTYPE_LONGLINK,
    tarfile.XHDTYPE,
    tarfile.XGLTYPE,
    tarfile.SOLARIS_XHDTYPE,
}


class BoundedTarInfo(tarfile.TarInfo):
    """Header of a tar's member, for the ``tarinfo`` of :func:`tarfile.open`.

    Python's own reads an extended header of any size into memory before it gives a member.

    Raises:
        tarfile.ReadError: an extended header is larger than LARGEST_EXTENSION.
    """

    @classmethod
    def fromtarfile(cls, tarfile: tarfile.TarFile) -> BoundedTarInfo:
        file = tarfile.fileobj
        assert file is not None
        start = file.tell()
        _require_bounded(file.read(512))
        file.seek(start)
        return super().fromtarfile(tarfile)


def _require_bounded(block: bytes) -> None:
    if block[156:157] not in _EXTENSIONS:  # the type's place in a header
        return
    try:
        info = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
    except tarfile.TarError:  # the end, or damage: that is told by who reads it in earnest
        return
    if info.size > LARGEST_EXTENSION:
        raise tarfile.ReadError(f"extended header of {info.size} bytes")
