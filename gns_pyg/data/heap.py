"""A damaged heap on which the HDF5 library (2.0.0 among others) would loop for ever, found before it is asked to read
the file. Variable-length strings, such as attributes, lie in these heaps."""

import mmap
import struct
from pathlib import Path

HEAD = struct.Struct("<4sB3sQ")  # signature, version, reserved, size of the collection
OBJECT = struct.Struct("<HH4xQ")  # number (0: free space), references, size
ALIGNED = 8  # objects begin at multiples of this


def endless_heap(path: Path) -> str | None:
    """Says where `path` holds a global heap whose free space has size 0: the library steps over it by that size.

    Source: HDF5 File Format Specification 3.0, section III.E (global heap).

    Args:
        path: any file.

    Returns:
        What is wrong, or None.
    """
    with path.open("rb") as file:
        if path.stat().st_size == 0:
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            start = content.find(b"GCOL")
            while start >= 0:
                if _endless(content, start):
                    return f"the global heap at byte {start} holds a free space of size 0"
                start = content.find(b"GCOL", start + 1)
    return None


def _endless(content: mmap.mmap, start: int) -> bool:
    if start + HEAD.size > len(content):
        return False
    _, version, reserved, size = HEAD.unpack_from(content, start)
    if version != 1 or reserved != bytes(3):  # four bytes of data that look like a heap's name
        return False
    at, end = start + HEAD.size, min(start + size, len(content))
    while at + OBJECT.size <= end:
        number, _, length = OBJECT.unpack_from(content, at)
        if number == 0 and length == 0:
            return True
        at += OBJECT.size + -(-length // ALIGNED) * ALIGNED if number else length
    return False
