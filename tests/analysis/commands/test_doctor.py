from importlib.metadata import PackageNotFoundError

import pytest

from splatpilot.analysis.commands import doctor
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.systems.common import extras
from splatpilot.systems.messaging import lcm_ports


def only(findings: list[doctor.Finding]) -> doctor.Finding:
    (finding,) = findings
    return finding


def test_working_parts_need_no_remedy(monkeypatch):
    monkeypatch.setattr(extras, "require_opengl", lambda: None)
    monkeypatch.setattr(lcm_ports, "open_lcm", lambda: None)
    for check in (doctor._program, doctor._processor, doctor._opengl, doctor._messages):
        assert only(check()).remedy == ""
    assert "SIMD levels v" in only(doctor._processor()).found
    assert only(doctor._video()).found.startswith("H.264")


def test_missing_parts_have_one_remedy(monkeypatch):

    def fails() -> None:
        raise OSError("there is no route; ip route add 224.0.0.0/4 dev lo")

    def absent(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(extras, "require_opengl", fails)
    monkeypatch.setattr(lcm_ports, "open_lcm", fails)
    for check in (doctor._opengl, doctor._messages):
        finding = only(check())
        assert finding.found == "there is no route" and finding.serves
        assert finding.remedy == "ip route add 224.0.0.0/4 dev lo"
    monkeypatch.setattr(doctor, "version", absent)
    remedies = {finding.what: finding.remedy for finding in doctor._extras()}
    assert remedies == {
        f"extra {extra}": f"pip install 'splatpilot[{extra}]'"
        for extra in extras.packages_of_extras()
        if extra != "cuda"
    }


def test_folders_are_found_through_their_variables(tmp_path, monkeypatch):
    (tmp_path / "hospital").mkdir()
    monkeypatch.setenv("SPLATPILOT_SCENES", str(tmp_path))
    scenes = only(doctor._scenes())
    there = [name for name in benchmark_scenarios() if name in scenes.found]
    assert there == ["R13"] and "R13" not in scenes.serves
    assert "R14" in scenes.serves and "SPLATPILOT_SCENES" in scenes.remedy
    monkeypatch.setenv("SPLATPILOT_DATA", str(tmp_path))
    assert only(doctor._data()) == doctor.Finding("data", f"{tmp_path}: hospital")
    monkeypatch.setenv("SPLATPILOT_DATA", str(tmp_path / "nowhere"))
    assert "No such folder" in only(doctor._data()).found
    monkeypatch.delenv("SPLATPILOT_DATA")
    assert "is not set" in only(doctor._data()).found


@pytest.mark.parametrize("driver", [False, True])
def test_an_unusable_gpu_differs_from_a_missing_one(driver, monkeypatch, tmp_path):
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor, "_DRIVER", tmp_path if driver else tmp_path / "nowhere")
    assert ("PyTorch" in only(doctor._gpu()).remedy) == driver
