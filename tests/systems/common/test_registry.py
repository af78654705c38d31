import sys
from dataclasses import dataclass

import pytest

from splatpilot.systems.common.registry import Registry, check_name, import_modules


@dataclass(frozen=True)
class Entry:
    config: type


class OneConfig:
    pass


class DerivedConfig(OneConfig):
    pass


@pytest.fixture
def registry() -> Registry[Entry]:
    registry = Registry("toy", "splatpilot.test_toys", Entry)
    registry.add("one", Entry(OneConfig))
    return registry


def package(folder, name: str, body: str, group: str = "", point: str = "") -> None:
    """Writes a module, and the metadata of an installation with an entry point."""
    (folder / f"{name}.py").write_text(body)
    if group:
        about = folder / f"{name}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[{group}]\n{point}\n")


def test_entries_are_found_by_name_and_by_configuration(registry):
    for config in (OneConfig(), DerivedConfig()):
        assert registry.entry_for(config) == registry.find("one") == Entry(OneConfig)
    registry.add("derived", Entry(DerivedConfig))
    assert registry.entry_for(DerivedConfig()) == Entry(DerivedConfig)
    with pytest.raises(ValueError, match=r"no toy 'two'; there are one, derived, and module:attr"):
        registry.find("two")
    with pytest.raises(ValueError, match=r"no toy has the configuration int; known are OneCon"):
        registry.entry_for(3)
    assert registry.modules() == {OneConfig.__module__}  # that other processes must import


def test_names_are_given_once(registry):
    registry.add("one", Entry(OneConfig))
    with pytest.raises(ValueError, match=r"there is a toy 'one' already"):
        registry.add("one", Entry(DerivedConfig))
    namesake = type("OneConfig", (), {"__module__": "elsewhere"})
    with pytest.raises(ValueError, match=r"has the name of .*OneConfig.*; rename it"):
        registry.add("two", Entry(namesake))


def test_same_qualified_name_is_replaced(registry):
    again = Entry(type("OneConfig", (), {"__module__": OneConfig.__module__}))
    registry.add("first", registry.find("one"))
    registry.add("one", again)
    assert registry.find("one") == registry.find("first") == registry.entry_for(again.config())
    assert registry.configs() == [again.config]
    with pytest.raises(ValueError, match=r"OneConfig was registered again after .*; make it again"):
        registry.entry_for(OneConfig())


def test_announced_entries_load_on_first_use(registry, tmp_path, monkeypatch):
    package(
        tmp_path,
        "announcer",
        "from test_registry_doubles import Entry\nclass FarConfig: pass\nFAR = Entry(FarConfig)\n",
        "splatpilot.test_toys",
        "far = announcer:FAR",
    )
    monkeypatch.setitem(sys.modules, "test_registry_doubles", sys.modules[Entry.__module__])
    monkeypatch.syspath_prepend(tmp_path)
    assert registry.names() == ["one", "far"]
    for name in ("one", "far", "module:Class"):
        check_name("toy", "splatpilot.test_toys", name, ["one"])
    with pytest.raises(ValueError, match=r"no toy 'two'; there are one, far, and module:attr"):
        check_name("toy", "splatpilot.test_toys", "two", ["one"])
    assert "announcer" not in sys.modules
    registry.load_announced()
    assert [config.__name__ for config in registry.configs()] == ["OneConfig", "FarConfig"]
    assert registry.find("far").config.__name__ == "FarConfig"


def test_module_and_attribute_name_an_entry(registry, tmp_path, monkeypatch):
    package(tmp_path, "loose", "class LooseConfig: pass\nNUMBER = 3\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(ValueError, match=r"'loose:Absent' is not at loose:Absent"):
        registry.find("loose:Absent")
    with pytest.raises(ValueError, match=r"loose:NUMBER must be a Entry of a toy"):
        registry.find("loose:NUMBER")
    registry.add("loose", Entry(sys.modules["loose"].LooseConfig))
    assert registry.find("loose:LooseConfig") == registry.find("loose")
    with pytest.raises(ValueError, match=r"the module nowhere cannot be imported"):
        import_modules(["nowhere"])
    package(tmp_path, "unfinished", "def f(:\n")
    with pytest.raises(ValueError, match=r"cannot be imported: .*unfinished\.py, line 1"):
        import_modules(["unfinished"])
