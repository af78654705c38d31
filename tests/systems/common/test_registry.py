import sys
from dataclasses import dataclass

import pytest

from splatpilot.systems.common.registry import Registry, check_name, import_modules


@dataclass(frozen=True)
class Kind:
    config: type


class OneConfig:
    pass


class DerivedConfig(OneConfig):
    pass


@pytest.fixture
def registry() -> Registry[Kind]:
    registry = Registry("thing", "splatpilot.test_things", Kind)
    registry.add("one", Kind(OneConfig))
    return registry


def package(folder, name: str, body: str, group: str = "", point: str = "") -> None:
    """Writes a module, and what an installation of it would announce."""
    (folder / f"{name}.py").write_text(body)
    if group:
        about = folder / f"{name}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[{group}]\n{point}\n")


def test_kinds_are_found_by_name_and_by_configuration(registry):
    """A name gives its kind; a configuration that of its type, or of the nearest base."""
    assert registry.find("one") == Kind(OneConfig)
    assert registry.entry_for(OneConfig()) == Kind(OneConfig)
    assert registry.entry_for(DerivedConfig()) == Kind(OneConfig)
    registry.add("derived", Kind(DerivedConfig))
    assert registry.entry_for(DerivedConfig()) == Kind(DerivedConfig)


def test_what_nobody_knows_is_refused_with_what_there_is(registry):
    with pytest.raises(ValueError, match=r"no thing 'two'; there are one, and module:attribute"):
        registry.find("two")
    with pytest.raises(ValueError, match=r"no thing has the configuration int; known are OneCon"):
        registry.entry_for(3)


def test_names_are_given_once(registry):
    """The same kind again is no error; another one of the name, or of a type of the same name in
    files, is."""
    registry.add("one", Kind(OneConfig))
    with pytest.raises(ValueError, match=r"there is a thing 'one' already"):
        registry.add("one", Kind(DerivedConfig))
    namesake = type("OneConfig", (), {})
    with pytest.raises(ValueError, match=r"has the name of .*OneConfig.*; rename it"):
        registry.add("two", Kind(namesake))


def test_announced_kinds_are_there(registry, tmp_path, monkeypatch):
    package(
        tmp_path,
        "announcer",
        "from test_registry_doubles import Kind\nclass FarConfig: pass\nFAR = Kind(FarConfig)\n",
        "splatpilot.test_things",
        "far = announcer:FAR",
    )
    monkeypatch.setitem(sys.modules, "test_registry_doubles", sys.modules[Kind.__module__])
    monkeypatch.syspath_prepend(tmp_path)
    assert registry.names() == ["one", "far"]
    for name in ("one", "far", "module:Class"):
        check_name("thing", "splatpilot.test_things", name, ["one"])
    with pytest.raises(ValueError, match=r"no thing 'two'; there are one, far, and module:attr"):
        check_name("thing", "splatpilot.test_things", "two", ["one"])
    assert "announcer" not in sys.modules
    registry.load_announced()
    assert [config.__name__ for config in registry.configs()] == ["OneConfig", "FarConfig"]
    assert registry.find("far").config.__name__ == "FarConfig"


def test_module_and_attribute_name_a_kind(registry, tmp_path, monkeypatch):
    """`module:attribute` is imported, also from the working directory; what is not there, or no
    such kind, is named."""
    package(tmp_path, "loose", "class LooseConfig: pass\nNUMBER = 3\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(ValueError, match=r"'loose:Absent' is not at loose:Absent"):
        registry.find("loose:Absent")
    with pytest.raises(ValueError, match=r"loose:NUMBER must be a Kind of a thing"):
        registry.find("loose:NUMBER")
    registry.add("loose", Kind(sys.modules["loose"].LooseConfig))
    assert registry.find("loose:LooseConfig") == registry.find("loose")
    with pytest.raises(ValueError, match=r"the module nowhere cannot be imported"):
        import_modules(["nowhere"])
    package(tmp_path, "unfinished", "def f(:\n")
    with pytest.raises(ValueError, match=r"cannot be imported: .*unfinished\.py, line 1"):
        import_modules(["unfinished"])


def test_modules_are_those_that_others_must_import(registry):
    assert registry.modules() == {OneConfig.__module__}
    assert Registry("thing", "splatpilot.test_things", Kind).modules() == set()
