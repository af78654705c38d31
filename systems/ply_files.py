"""Reading PLY files, whose headers are compared with the files' size before anything is read."""

from pathlib import Path

from plyfile import PlyData, PlyElementParseError

from splatpilot.systems.array_files import reason_of
from splatpilot.systems.read_limit import require_readable_size

_MAX_HEADER = 1 << 16  # [bytes]
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
"""[bytes], of a number in binary."""


def read_ply_file(path: Path) -> PlyData:
    """
    The elements of a PLY file, binary of either byte order or ASCII.

    Raises:
        ValueError: if it is none, cut short, damaged, or would take more memory than `read_limit`
            allows; the message names it.
    """
    size = path.stat().st_size
    require_readable_size(path, size)
    with path.open("rb") as file:
        start = file.read(_MAX_HEADER)
    try:
        least = _least_size(start)
    except (ValueError, LookupError) as error:
        raise ValueError(f"{path}: not a PLY file ({reason_of(error)})") from None
    if least > size:
        raise ValueError(
            f"{path}: the data do not match the header, which claims {least} bytes or more of "
            f"{size}; the file is truncated or damaged, copy it again"
        )
    try:
        return PlyData.read(str(path))
    except PlyElementParseError as error:
        raise ValueError(
            f"{path}: the data do not match the header ({reason_of(error)}); the file is truncated "
            "or damaged, copy it again"
        ) from None
    except Exception as error:  # plyfile raises anything of damaged files
        raise ValueError(f"{path}: not a PLY file ({reason_of(error)})") from None


def _least_size(start: bytes) -> int:
    """The least bytes that a file has whose header begins so."""
    header, end, _ = start.partition(b"end_header")
    if not start.startswith(b"ply") or not end:
        raise ValueError("no header from 'ply' to 'end_header' begins it")
    ascii_text = False
    elements: list[list[int]] = []  # rows, and the least bytes of each
    for line in header.decode("ascii").splitlines():
        match line.split():
            case ["format", kind, _]:
                ascii_text = kind == "ascii"
            case ["element", _, number]:
                elements.append([int(number), 0])
            case ["property", "list", kind, _, _] | ["property", kind, _]:
                # In a text a digit and what parts it from the next.
                elements[-1][1] += 2 if ascii_text else _SIZES[kind]
    for rows, row in elements:
        if rows < 0 or (rows > 0 and row == 0):
            raise ValueError(f"an element claims {rows} rows of {row} bytes")
    return len(header) + len(end) + sum(rows * row for rows, row in elements)
