"""`splatpilot doctor` and `headlines`: what works on this machine, what to install, and speeds."""

import argparse
import importlib.util
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands import options as cli
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.systems.common.extras import packages_of_extras
from splatpilot.systems.common.files import (
    DATA,
    SCENES,
    data_folder,
    require_writable_folder,
    scenes_folder,
    write_text,
)
from splatpilot.systems.common.processes import available_cores
from splatpilot.systems.common.readers import error_summary

_DRIVER = Path("/proc/driver/nvidia")

_USES = {
    "cluster": "`splatpilot benchmark --cluster`",
    "exr": "depth of Record3D's exports",
    "gym": "reinforcement learning in Gymnasium",
    "lerobot": "`splatpilot corpus export`",
    "mesh": "`splatpilot scene mesh`",
    "mocap": "OptiTrack in `splatpilot hardware px4`",
    "onnx": "networks of policies as ONNX",
    "photos": "photographs without poses, and COLMAP models",
    "px4": "`splatpilot hardware px4`",
    "rerun": "`splatpilot fly --rerun`",
    "tensorboard": "curves in TensorBoard",
    "train": "training, reconstruction and metrics of scenes",
    "ros": "captures in ROS bags",
    "spz": "Gaussians in SPZ of version 4",
    "usd": "Gaussians in USD",
}
"""The use of each extra."""


@dataclass(frozen=True)
class Finding:
    """A part of this machine."""

    what: str
    found: str
    remedy: str = ""  # what to install or set; empty if nothing is missing
    serves: str = ""  # what is impossible without it


@cli.command("doctor", cli.json_option("the findings"), examples=("doctor", "doctor --json"))
def doctor(options: argparse.Namespace) -> list[Finding]:
    """Checks processor, GPU, EGL, the route of LCM messages, the video encoder, the packages of
    each extra, data and scenes. Each missing part has one remedy."""
    machine = _program, _processor, _gpu, _opengl, _messages, _video
    findings = [each for check in (*machine, _extras, _data, _scenes) for each in check()]
    print(format_findings(findings))
    return findings


@cli.command(
    "headlines",
    cli.json_option("the measured values"),
    cli.out_option("Markdown file to write", required=False, unused=True),
    cli.OVERWRITE,
    examples=("headlines", "headlines --out headlines.md", "headlines --json"),
)
def headlines(options: argparse.Namespace) -> dict[str, Any]:
    """Measures the speeds that the documentation states on this machine, with pass marks, in two
    minutes of an idle CPU. With a GPU, it also measures that for at most twelve minutes."""
    cli.announce("measuring speeds for about two minutes; with a GPU, up to twelve more")
    from splatpilot.analysis.headlines import run

    if options.out is not None:
        require_writable_folder(options.out.absolute().parent)
    result = run()
    if options.out is not None:
        write_text(options.out, result["table"])
    return {name: value for name, value in result.items() if name != "table"}


def format_findings(findings: list[Finding]) -> str:
    """Formats a line for each finding, and one for each remedy."""
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
        return []  # The finding of the extra "train" comes first.
    except (ImportError, OSError) as error:
        found = f"PyTorch does not load: {error_summary(error)}"
        return [Finding("GPU", found, "install PyTorch again", serves)]
    if not torch.cuda.is_available():
        if not _DRIVER.exists():
            return [Finding("GPU", "no driver", "an NVIDIA GPU and its driver", serves)]
        found = f"not usable by PyTorch {torch.__version__}"
        remedy = "a PyTorch for this driver, see https://pytorch.org/get-started/locally"
        return [Finding("GPU", found, remedy, serves)]
    name = torch.cuda.get_device_name()
    if importlib.util.find_spec("gsplat") is None:
        return [Finding("GPU", f"{name}, no gsplat", "pip install 'splatpilot[cuda]'", serves)]
    return [Finding("GPU", f"{name}, gsplat {version('gsplat')}")]


def _opengl() -> list[Finding]:
    from splatpilot.systems.common.extras import require_opengl

    works = "Drake's RenderEngineVtk renders"
    return _try(require_opengl, "EGL", works, "captures rendered of meshes")


def _messages() -> list[Finding]:
    from splatpilot.systems.messaging.lcm_ports import DEFAULT_URL, open_lcm

    serves = "`splatpilot hardware vehicle`, `bridge` and `px4`"
    return _try(open_lcm, "messages", f"LCM delivers at {DEFAULT_URL}", serves)


def _try(call: Callable[[], object], what: str, works: str, serves: str) -> list[Finding]:
    """Calls a function, whose errors have the problem and, after a semicolon, the remedy."""
    try:
        call()
    except OSError as error:
        found, _, remedy = str(error).partition("; ")
        return [Finding(what, found, remedy, serves)]
    return [Finding(what, works)]


def _video() -> list[Finding]:
    import av
    from av.codec.codec import UnknownCodecError

    try:
        av.Codec("libx264", "w")
    except UnknownCodecError:
        return [Finding("video", f"no H.264 in PyAV {av.__version__}", "pip install av", "videos")]
    return [Finding("video", f"H.264 by PyAV {av.__version__}")]


def _extras() -> list[Finding]:
    findings = []
    for extra, packages in packages_of_extras().items():
        if extra == "cuda":  # covered by the GPU
            continue
        missing = [name for name in packages if not _is_installed(name)]
        found = f"no {', '.join(missing)}" if missing else ", ".join(packages)
        remedy = f"pip install 'splatpilot[{extra}]'" if missing else ""
        findings.append(Finding(f"extra {extra}", found, remedy, _USES[extra]))
    return findings


def _is_installed(package: str) -> bool:
    try:
        version(package)
    except PackageNotFoundError:
        return False
    return True


def _data() -> list[Finding]:
    folder = data_folder()
    if folder is not None and folder.is_dir():
        names = ", ".join(sorted(path.name for path in folder.iterdir() if path.is_dir()))
        return [Finding("data", f"{folder}: {names or 'empty'}")]
    found = f"{DATA} is not set" if folder is None else f"No such folder: {folder}"
    remedy = f"export {DATA}=FOLDER of captures and meshes"
    serves = "`splatpilot library make`, and tests on real captures"
    return [Finding("data", found, remedy, serves)]


def _scenes() -> list[Finding]:
    from splatpilot.analysis.benchmark.run_study import absent_scenes
    from splatpilot.diagrams.flight.scenario import Scenario
    from splatpilot.diagrams.worlds.scene_folder import SceneSource
    from splatpilot.systems.common.config import load_config

    loaded = {name: load_config(Scenario(), file) for name, file in benchmark_scenarios().items()}
    scenarios = {name: s for name, s in loaded.items() if isinstance(s.world, SceneSource)}
    absent = absent_scenes(scenarios)
    present = ", ".join(name for name in scenarios if name not in absent)
    found = f"{present or 'no scenario'} can be flown from {scenes_folder()}"
    if not absent:
        return [Finding("scenes", found)]
    remedy = f"splatpilot library make, or export {SCENES}=FOLDER of scenes"
    return [Finding("scenes", found, remedy, f"the scenarios {', '.join(absent)}")]
