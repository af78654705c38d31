"""What this machine can do, and what to install or set for the rest."""

import importlib.util
import platform
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.systems.common.extras import packages_of_extras
from splatpilot.systems.common.files import DATA, SCENES, data_folder, scenes_folder
from splatpilot.systems.common.processes import available_cores

_DRIVER = Path("/proc/driver/nvidia")

_SERVED = {
    "cluster": "`splatpilot benchmark --cluster`",
    "exr": "depth of Record3D's exports",
    "mesh": "`splatpilot scene mesh`",
    "mocap": "OptiTrack in `splatpilot hardware px4`",
    "photos": "photographs without poses, and COLMAP models",
    "px4": "`splatpilot hardware px4`",
    "tensorboard": "curves in TensorBoard",
    "train": "training, reconstruction and measures of scenes",
    "ros": "captures in ROS bags",
    "spz": "Gaussians in SPZ of version 4",
}
"""What each extra is for."""


@dataclass(frozen=True)
class Finding:
    """One thing that this machine has or lacks."""

    what: str
    found: str
    """In words."""
    remedy: str = ""
    """The one thing to install or set; empty where nothing lacks."""
    serves: str = ""
    """What cannot be done without it."""


def examine() -> list[Finding]:
    """Looks for all that some part of splatpilot needs."""
    checks: tuple[Callable[[], list[Finding]], ...] = (
        _program,
        _processor,
        _gpu,
        _opengl,
        _messages,
        _video,
        _browser,
        _extras,
        _data,
        _scenes,
    )
    return [finding for check in checks for finding in check()]


def format_findings(findings: list[Finding]) -> str:
    """A line for each, and one more for the remedy of what lacks."""
    width = max(len(finding.what) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f"{'-' if finding.remedy else '+'} {finding.what:<{width}}  {finding.found}")
        if finding.remedy:
            lines.append(f"  {'':<{width}}  for {finding.serves}: {finding.remedy}")
    return "\n".join(lines)


def _program() -> list[Finding]:
    packages = ", ".join(f"{name} {version(name)}" for name in ("splatpilot", "drake"))
    python = f"Python {platform.python_version()}"
    return [Finding("program", f"{packages}, {python}, {platform.platform()}")]


def _processor() -> list[Finding]:
    from splatpilot import _native

    levels = ", ".join(_native.simd_levels())
    return [Finding("processor", f"{available_cores()} cores, SIMD levels {levels or 'none'}")]


def _gpu() -> list[Finding]:
    serves = "training and reconstruction on a GPU (device=cuda)"
    try:
        import torch
    except ModuleNotFoundError:
        return []  # What `extra train` says comes first.
    if not torch.cuda.is_available():
        if not _DRIVER.exists():
            return [Finding("GPU", "no driver", "an NVIDIA GPU and its driver", serves)]
        found = f"PyTorch {torch.__version__} cannot use the one that there is"
        remedy = "a PyTorch for this driver, see https://pytorch.org/get-started/locally"
        return [Finding("GPU", found, remedy, serves)]
    name = torch.cuda.get_device_name()
    if importlib.util.find_spec("gsplat") is None:
        return [Finding("GPU", f"{name}, no gsplat", "pip install 'splatpilot[cuda]'", serves)]
    return [Finding("GPU", f"{name}, gsplat {version('gsplat')}")]


def _opengl() -> list[Finding]:
    from splatpilot.systems.common.extras import require_opengl

    try:
        require_opengl()
    except OSError as error:
        return [_lacking("EGL", error, "captures rendered of meshes")]
    return [Finding("EGL", "Drake's RenderEngineVtk renders")]


def _messages() -> list[Finding]:
    from splatpilot.systems.messaging.lcm_ports import DEFAULT_URL, open_lcm

    try:
        open_lcm()
    except OSError as error:
        return [_lacking("messages", error, "`splatpilot hardware vehicle`, `bridge` and `px4`")]
    return [Finding("messages", f"LCM delivers at {DEFAULT_URL}")]


def _lacking(what: str, error: OSError, serves: str) -> Finding:
    """What an error says, whose remedy stands behind its semicolon."""
    found, _, remedy = str(error).partition("; ")
    return Finding(what, found, remedy, serves)


def _video() -> list[Finding]:
    import av
    from av.codec.codec import UnknownCodecError

    try:
        av.Codec("libx264", "w")
    except UnknownCodecError:
        return [Finding("video", f"no H.264 in PyAV {av.__version__}", "pip install av", "videos")]
    return [Finding("video", f"H.264 by PyAV {av.__version__}")]


def _browser() -> list[Finding]:
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if chromium is None:
        return [Finding("browser", "no Chromium", "apt install chromium", "the tests of pages")]
    return [Finding("browser", chromium)]


def _extras() -> list[Finding]:
    findings = []
    for extra, packages in packages_of_extras().items():
        lacking = [name for name in packages if not _is_installed(name)]
        if extra == "cuda" or not packages:  # The GPU's finding has it.
            continue
        found = f"no {', '.join(lacking)}" if lacking else ", ".join(packages)
        remedy = f"pip install 'splatpilot[{extra}]'" if lacking else ""
        findings.append(Finding(f"extra {extra}", found, remedy, _SERVED[extra]))
    return findings


def _is_installed(package: str) -> bool:
    try:
        version(package)
    except PackageNotFoundError:
        return False
    return True


def _data() -> list[Finding]:
    folder, serves = data_folder(), "`splatpilot scene fetch`, and tests on real captures"
    if folder is None or not folder.is_dir():
        found = f"{DATA} is not set" if folder is None else f"{folder} is no folder"
        return [Finding("data", found, f"export {DATA}=FOLDER of captures and meshes", serves)]
    held = ", ".join(sorted(path.name for path in folder.iterdir() if path.is_dir()))
    return [Finding("data", f"{folder}: {held or 'empty'}")]


def _scenes() -> list[Finding]:
    from splatpilot.analysis.benchmark.run_study import absent_scenes
    from splatpilot.diagrams.flight.scenario import Scenario
    from splatpilot.diagrams.worlds.scene_folder import SceneSource
    from splatpilot.systems.common.config import load_config

    scenarios = {
        name: scenario
        for name, file in benchmark_scenarios().items()
        if isinstance((scenario := load_config(Scenario(), file)).world, SceneSource)
    }
    absent = absent_scenes(scenarios)
    there = ", ".join(name for name in scenarios if name not in absent)
    found = f"{scenes_folder()} has those of {there or 'no scenario'}"
    if not absent:
        return [Finding("scenes", found)]
    remedy = f"splatpilot scene fetch, or export {SCENES}=FOLDER of scenes"
    return [Finding("scenes", found, remedy, f"the scenarios {', '.join(absent)}")]
