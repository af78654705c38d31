"""The scenarios and profiles that come with the program, one YAML file each."""

from pathlib import Path

from splatpilot.systems.common.files import locate_scene
from splatpilot.systems.common.validation import require, unknown

_FOLDER = Path(__file__).parent


def benchmark_scenarios() -> dict[str, Path]:
    """Returns the files of the benchmark's scenarios by name."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.yaml"))}


def other_scenarios() -> dict[str, Path]:
    """Returns the files of the scenarios outside the benchmark by name."""
    return {path.stem: path for path in sorted((_FOLDER / "others").glob("*.yaml"))}


def profiles() -> dict[str, Path]:
    """Returns the files of the profiles, fields that any scenario may have, by name."""
    return {path.stem: path for path in sorted((_FOLDER / "profiles").glob("*.yaml"))}


def scenario_file(scenario: str) -> Path:
    """Returns the file of a scenario, given by its name or its path."""
    known = benchmark_scenarios() | other_scenarios()
    remedy = f"fly --scene {scenario}, or Scenario(world=SceneConfig(path={scenario!r}))"
    scene = None if scenario in known else locate_scene(scenario)
    is_scene = scene is not None and (scene / "scene.yaml").is_file()
    require(not is_scene, scenario, "the name or file of a scenario", "a scene", remedy)
    return _file("scenario", scenario, known)


def profile_file(profile: str) -> Path:
    """Returns the file of a profile, given by its name or its path."""
    return _file("profile", profile, profiles())


def _file(what: str, name: str, known: dict[str, Path]) -> Path:
    if name in known:
        return known[name]
    if Path(name).suffix in (".yaml", ".yml") or Path(name).is_file():
        return Path(name)
    raise ValueError(unknown(what, name, known, "and others as YAML files"))
