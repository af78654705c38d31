"""Objects that take turns on a Meshcat scene."""

from pydrake.geometry import Meshcat


def show_page(meshcat: Meshcat, path: str, page: int, time: float, keep: bool = False) -> None:
    """
    Shows the object that has just been set at `page_path(path, page)` from `time` on.

    Meshcat's recordings keep transforms and properties but no geometry, so geometry that changes is
    drawn as a flipbook: every version is an object of its own, hidden at the start of the recording
    and made visible when its time comes.

    Args:
        path: the flipbook.
        page: number of the page; pages are shown in the order 0, 1, 2...
        time: simulation time [s].
        keep: leave the page before visible too, as a trail does.
    """
    if time > 0.0:
        meshcat.SetProperty(page_path(path, page), "visible", False, 0.0)
    meshcat.SetProperty(page_path(path, page), "visible", True, time)
    if page > 0 and not keep:
        meshcat.SetProperty(page_path(path, page - 1), "visible", False, time)


def page_path(path: str, page: int) -> str:
    """The Meshcat path of one page of a flipbook."""
    return f"{path}/{page:05d}"
