import json
import time
from collections.abc import Iterator

import pytest

from splatpilot.analysis import headlines
from splatpilot.analysis.commands.main import main
from splatpilot.analysis.headlines import Effort, Headline

TINY = Effort(vehicles=4, views=2, worlds=1, rounds=1, steps=1, updates=1)


def passes(effort: Effort) -> Iterator[Headline]:
    yield Headline("images", 1234.5, "images/s", min=1000)
    yield Headline("render", 20.0, "ms", max=5)


def breaks(effort: Effort) -> Iterator[Headline]:
    yield from passes(effort)
    raise RuntimeError("out of memory\nat a line")


def hangs(effort: Effort) -> None:
    time.sleep(30)


def needs_package(effort: Effort) -> None:
    raise ModuleNotFoundError("No module named 'torch'", name="torch")


def test_parts_that_fail_are_named_and_keep_their_values(capsys):
    parts = {"broken": breaks, "slow": hangs, "bare": needs_package, "sound": passes}
    result = headlines.run({name: (part, 0.2) for name, part in parts.items()}, TINY)
    assert result["failures"] == {
        "broken": "out of memory at a line",
        "slow": "not finished within 0.2 s",
        "bare": "bare needs torch; pip install 'splatpilot[train]'",
    }
    assert [row["passed"] for row in result["rows"]] == [True, False] * 2
    assert capsys.readouterr().out == result["table"]


@pytest.mark.parametrize("part", ["environments", "images", "flight"])
def test_parts_measure_positive_values(part):
    result = headlines.run({part: headlines.CPU_PARTS[part]}, TINY)
    assert result["failures"] == {} and result["rows"]
    assert all(row["value"] > 0 for row in result["rows"])


def test_agreement_of_one_device_is_exact():
    median, share = headlines.gpu_agreement(TINY, "cpu")
    assert (median.value, share.value) == (0, 0) and median.passed and share.passed


def test_command_writes_a_table_and_json(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(headlines, "CPU_PARTS", {"sound": (passes, 0.0)})
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    out = tmp_path / "headlines.md"
    assert main(["headlines", "--json", "--out", str(out)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [row["what"] for row in result["rows"]] == ["images", "render"]
    lines = out.read_text().splitlines()
    assert lines[0] == result["machine"] and "SIMD levels" in lines[0]
    assert "| images | 1,234 images/s | >= 1,000 | yes |" in lines
    assert "| render | 20 ms | <= 5 | no |" in lines
    assert lines[-1] == "Not measured: GPU: PyTorch finds no GPU."
    assert main(["headlines", "--out", str(out)]) == 1
