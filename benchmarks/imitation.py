"""What decides how well a student imitates: trainings that differ in some fields.

    python benchmarks/imitation.py OUT student_rgb --measure CORPUS \\
        --line 'drawn looks' 'corpora=[CORPUS]' --line 'one look' 'corpora=[PLAIN]' \\
        --case 8 worlds=8 --case 32 worlds=32 --case 128 worlds=128 --seeds 0 1 2 --xlabel worlds

Each case of each line is trained once for each seed, in a folder of OUT; the same command goes on
where it was interrupted, and with more of any it adds to them. What is printed is measured on the
worlds that the corpus of --measure holds out, whatever was trained on, of the same worlds: the mean
over seeds and its 95 % interval by Student's t. Where all cases are numbers they are also drawn, in
OUT/curve.png.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy.stats import t

from splatpilot.systems.common.config import load_config
from splatpilot.training.policies.train import run
from splatpilot.training.policies.trainer_registry import TRAINERS

MEASURES = "success", "clear", "error", "best_chosen"


def measured(policy: str, overrides: list[str], corpus: str, out: Path) -> list[float]:
    """`MEASURES` of a training, which is done if it is not yet there, on another corpus."""
    kind = TRAINERS.find(policy)
    config = load_config(kind.config(), overrides=overrides)
    if not (out / "summary.json").exists():
        run(config=config, out=out, make=kind.make)
    trainer = kind.make(replace(config, corpora=[corpus], worlds=1))
    with np.load(out / f"{policy}.npz") as weights:
        state = {name: torch.from_numpy(weights[name]) for name in trainer.network.state_dict()}
    trainer.network.load_state_dict(state)
    found = trainer.evaluate()
    return [found[name] for name in MEASURES]


def half_interval(values: np.ndarray) -> np.ndarray:
    """Of the mean over the first axis, at 95 %; infinite for one value."""
    n = len(values)
    if n == 1:
        return np.full(values.shape[1:], np.inf)
    return t.ppf(0.975, n - 1) * values.std(axis=0, ddof=1) / np.sqrt(n)


def draw(cases: list[float], lines: dict[str, np.ndarray], xlabel: str, path: Path) -> None:
    """Success over the cases, with intervals, of lines (seeds, cases)."""
    figure, axes = plt.subplots(figsize=(5.0, 3.2), layout="constrained")
    for name, successes in lines.items():
        mean, half = successes.mean(axis=0), half_interval(successes)
        axes.errorbar(cases, 100.0 * mean, 100.0 * half, marker="o", capsize=3.0, label=name)
    axes.set(xscale="log", xlabel=xlabel, ylabel="success on held-out worlds [%]")
    axes.set_xticks(cases, [f"{case:g}" for case in cases])
    axes.minorticks_off()
    axes.legend()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("policy")
    parser.add_argument("--measure", required=True, metavar="CORPUS")
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE")
    parser.add_argument(
        "--case", action="append", nargs="+", required=True, metavar="NAME FIELD=VALUE"
    )
    parser.add_argument(
        "--line", action="append", nargs="+", default=[], metavar="NAME FIELD=VALUE"
    )
    parser.add_argument("--xlabel", default="case", help="what the cases' numbers are")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    args = parser.parse_args()
    print("| line | case | " + " | ".join(MEASURES) + " |")
    lines = {}
    for line, *common in args.line or [["all"]]:
        successes = []
        for case, *own in args.case:
            settings = [*args.set, *common, *own]
            folder = args.out / line.replace(" ", "_") / case
            values = np.array(
                [
                    measured(
                        args.policy,
                        [*settings, f"seed={seed}"],
                        args.measure,
                        folder / f"seed_{seed}",
                    )
                    for seed in args.seeds
                ]
            )
            shown = zip(values.mean(axis=0), half_interval(values), strict=True)
            cells = [line, case, *(f"{mean:.3f} ± {half:.3f}" for mean, half in shown)]
            print("| " + " | ".join(cells) + " |", flush=True)
            successes.append(values[:, 0])
        lines[line] = np.stack(successes, axis=1)
    cases = [case for case, *_ in args.case]
    if all(case.replace(".", "", 1).isdigit() for case in cases):
        draw([float(case) for case in cases], lines, args.xlabel, args.out / "curve.png")


if __name__ == "__main__":
    main()
