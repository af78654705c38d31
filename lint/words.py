"""Counts phrases that the style of this project avoids; a baseline of counts may only shrink.

python lint/words.py             # fails where a file has more hits than lint/baseline.txt has
python lint/words.py --update    # writes lower counts into the baseline
"""

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

BASELINE = Path(__file__).parent / "baseline.txt"
INSTEAD = {
    r'^\s*"""(What|Whether|How|Where|Who|Whose|Of|Which)\b': "begin with a verb",
    r"def \w+_of\(": "a noun or a verb",
    r"\b(is|are) none\b|\b(is|are) no \w+ (file|text|dataclass|number)\b": "is not a ...",
    r"\bof which\b|\bwhoever\b|\bnobody\b|\bsomebody\b": "two sentences, or the component's name",
    r"\bwhat (stands|there is|is there|nobody)\b": "the thing's name",
    r"\bwhole or not at all\b": "atomically",
    r"\banew\b": "again",
    r"\bgo(es)? on\b": "resume, continue",
    r"\bwithheld\b": "held-out",
    r"\bgather(s|ed|ing)?\b": "collect",
    r"\bdisturb(?!ance)": "corrupt, add noise",
    r"\bjudge[sd]?\b": "predict, estimate",
    r"\bin a mirror\b": "flipped",
    r"\bleaky rectifier\b": "leaky ReLU",
    r"\bturned (by|about|box)\b|turned_": "rotated",
    r"\bballs?\b": "sphere",
    r"\bwanted\b": "desired",
    r"\basked for\b": "commanded, requested",
    r"\bleast_|_least\b|\bmost_|MOST_": "min_, max_",
    r"\bNEAREST\b|\bFARTHEST\b": "MIN_DEPTH, MAX_DEPTH",
    r"\bverbs?\b": "command",
    r"\bmistakes?\b": "error, bug",
    r"\blacks?\b": "is missing",
    r"\bclaims?\b": "declares",
    r"\bmend(s|ed)?\b": "fix, repair",
    r"\bmakes? no sense\b": "is invalid",
    r"\bsame bits\b|\bbit for bit\b": "bitwise identical",
    r"\binfinitely far\b|\bbackdrop\b": "background, sky",
    r"\b(now and then|for good|for ever|for want of|sees? to it|at hand|seldom)\b": "plain words",
    r"(?<!half-)(?<!two-)\bways?\b": "path, route, method",
    r"\bplaces?\b": "scene, environment",
    r"\bcolou?r(s)? (that|alone)\b|\bby colours?\b": "RGB",
    r"colour|grey|metre|centre|normalis|optimis|neighbour|rasteris": "American spelling",
    r"(it|they) must be|is needed|are needed|needed is": "... must be ..., got ...",
}
PATTERN = re.compile("|".join(f"(?:{phrase})" for phrase in INSTEAD))


def count_hits(root: Path) -> Counter[str]:
    """Counts lines with avoided phrases in each tracked file of source and documentation."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py", "*.cpp", "*.hpp", "*.md"],
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    hits = Counter()
    for name in listed:
        if not name.startswith(("tests/", "lint/")) and (root / name).is_file():
            lines = (root / name).read_text().splitlines()
            hits[name] = sum(bool(PATTERN.search(line)) for line in lines)
    return +hits


def main() -> int:
    """Compares the counts with the baseline; returns the exit status."""
    hits = count_hits(BASELINE.parents[1])
    lines = (line.split() for line in BASELINE.read_text().splitlines())
    allowed = Counter({name: int(count) for count, name in lines})
    worse = {name: count for name, count in hits.items() if count > allowed[name]}
    if "--update" in sys.argv:
        kept = sorted((name, count) for name, count in hits.items() if name not in worse)
        BASELINE.write_text("".join(f"{count} {name}\n" for name, count in kept))
    for name, count in sorted(worse.items()):
        print(f"{name}: avoided phrases must be on at most {allowed[name]} lines, got {count}")
        for number, line in enumerate((BASELINE.parents[1] / name).read_text().splitlines(), 1):
            for phrase, instead in INSTEAD.items():
                if found := re.search(phrase, line):
                    print(f"  {number}: {found[0].strip()!r} -> {instead}")
    return min(len(worse), 1)


if __name__ == "__main__":
    raise SystemExit(main())
