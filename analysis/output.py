"""Tables and figures that studies write."""

import csv
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpilot.systems.common.files import written_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes rows as CSV, atomically, with the columns of all of them."""
    rows = list(rows)
    columns = list(dict.fromkeys(column for row in rows for column in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with written_atomically(path) as partial:
        partial.write_text(text.getvalue())


def write_png(figure: "Figure", path: Path, dpi: int = 130) -> bytes:
    """Writes a figure as PNG, atomically, and returns the bytes, which are deterministic."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_atomically(path) as partial:
        partial.write_bytes(buffer.getvalue())
    return buffer.getvalue()
