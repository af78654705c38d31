"""Any place as a page to look at, or served: a scene, a PLY, a capture or a generated world."""

from collections.abc import Sequence
from pathlib import Path

from splatpilot.analysis.shown_place import generated_scenario, shown_place
from splatpilot.diagrams.meshcat import empty_meshcat
from splatpilot.systems.files import require_unused, require_writable_folder, written_atomically
from splatpilot.systems.visualization.drawing import (
    BALL,
    GOAL_COLOR,
    START_COLOR,
    draw_box,
    draw_goal,
)
from splatpilot.systems.visualization.place_page import place_page
from splatpilot.systems.visualization.viser_place import serve_place


def run(
    *,
    what: str,
    out: Path | None = None,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    overwrite: bool = False,
) -> Path:
    """Writes the page of a place, prints where, and returns that.

    Args:
        what: a scene folder, a PLY, the folder of a capture, or a scenario.
        out: the page; `out/view/NAME.html` if None, or `NAME-SEED.html` of a generated world.
        seed: of a generated world; that of its scenario if None.
        overrides: FIELD=VALUE of the scenario, or of the capture's `CaptureConfig`.
        overwrite: the page, if it is there.

    Raises:
        FileNotFoundError, ValueError, OSError: see `shown_place`; or if the page is there and not
            to be overwritten, or cannot be written.
    """
    path = Path(what)
    name = path.resolve().name if path.is_dir() else path.stem
    if (scenario := generated_scenario(path, seed, overrides)) is not None:
        name = f"{name}-{scenario.seed:03d}"
    out = out or Path("out/view") / f"{name}.html"
    require_unused(out, overwrite)
    place = shown_place(what, seed, overrides)
    require_writable_folder(out.absolute().parent)
    meshcat = empty_meshcat(place.background)
    draw_box(meshcat, "/splatpilot/bounds", place.lower_W, place.upper_W)
    for p, name, color in zip(
        place.ends or (), ("start", "goal"), (START_COLOR, GOAL_COLOR), strict=False
    ):
        draw_goal(meshcat, f"/splatpilot/{name}", p, BALL, color)
    with written_atomically(out) as partial:
        partial.write_text(place_page(meshcat.StaticHtml(), place))
    print(f"Wrote {out}, a page for any browser")
    return out


def serve(*, what: str, seed: int | None = None, overrides: Sequence[str] = ()) -> None:
    """Serves a place with viser until it is interrupted, and prints where; for the arguments see
    `run`.

    Raises:
        ModuleNotFoundError: if viser is not installed; the message says what to install.
        FileNotFoundError, ValueError, OSError: see `shown_place`.
    """
    server = serve_place(shown_place(what, seed, overrides))
    print(f"Look at http://localhost:{server.get_port()}; Ctrl-C ends it", flush=True)
    try:
        server.sleep_forever()
    finally:
        server.stop()
