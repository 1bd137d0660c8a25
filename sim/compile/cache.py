"""Compiled programs on disk, in the user's cache folder.

An entry is one file: a magic number, a SHA-256 of the rest, then a pickle-free archive of named byte strings.
Files are written under another name and moved into place, so that readers see whole entries or none; a torn
or foreign file counts as absent.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path

_MAGIC = b"PGSM\x00\x01\r\n"
_DIGEST = 32


def default_folder() -> Path:
    """Where this user's compiled programs are kept: XDG_CACHE_HOME, or the platform's usual place."""
    root = os.environ.get("XDG_CACHE_HOME")
    if root and Path(root).is_absolute():
        base = Path(root)
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path.home() / ".cache"
    return base / "pantograph" / "smooth"


def key_of(*parts: bytes | str) -> str:
    """Name of an entry: a hash over everything its content depends on."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()[:40]


@cache
def source(file: str) -> str:
    """Hash of a source file, for code whose programs are kept."""
    return key_of(Path(file).read_bytes())


def pack(entry: Mapping[str, bytes]) -> bytes:
    """Entry as one byte string."""
    index = json.dumps({name: len(data) for name, data in entry.items()}).encode()
    body = len(index).to_bytes(8, "little") + index + b"".join(entry.values())
    return _MAGIC + hashlib.sha256(body).digest() + body


def unpack(data: bytes) -> dict[str, bytes] | None:
    """Entry of a byte string, or None when it is torn or not an entry."""
    head = len(_MAGIC) + _DIGEST
    body = data[head:]
    if data[: len(_MAGIC)] != _MAGIC or hashlib.sha256(body).digest() != data[len(_MAGIC) : head]:
        return None
    size = int.from_bytes(body[:8], "little")
    out, at = {}, 8 + size
    for name, length in json.loads(body[8:at]).items():
        out[name] = body[at : at + length]
        at += length
    return out


class Cache:
    """Entries by key in one folder; a folder that cannot be used makes a cache that is always empty."""

    def __init__(self, folder: Path | None):
        self.folder = folder

    def _path(self, key: str) -> Path | None:
        return None if self.folder is None else self.folder / key[:2] / f"{key}.pgsm"

    def get(self, key: str) -> dict[str, bytes] | None:
        """The entry, or None."""
        path = self._path(key)
        if path is None:
            return None
        try:
            return unpack(path.read_bytes())
        except OSError:
            return None

    def put(self, key: str, entry: Mapping[str, bytes]) -> None:
        """Store an entry; a disk that refuses is no error, the work is just done again next time."""
        path = self._path(key)
        if path is None:
            return
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(pack(entry))
                Path(name).replace(path)
            except OSError:
                Path(name).unlink(missing_ok=True)
                raise
