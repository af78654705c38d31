"""Parts of a study that are flown apart."""

from dataclasses import dataclass
from typing import Self

from splatpilot.analysis.benchmark.study import RolloutSpec


@dataclass(frozen=True)
class Shard:
    """The share of one of `total` parts of a study: every `total`-th place, from the `number`-th
    on. Flights through one place, a scenario and seed, stay together."""

    number: int  # from 1
    total: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """
        Reads "i/n".

        Raises:
            ValueError: unless i is 1 to n.
        """
        number, slash, total = text.partition("/")
        if not (slash and number.isdecimal() and total.isdecimal()) or not (
            1 <= int(number) <= int(total)
        ):
            raise ValueError(f"the shard {text!r} is none; write i/n with i from 1 to n, like 2/8")
        return cls(int(number), int(total))

    def __str__(self) -> str:
        return f"{self.number}/{self.total}"

    def of(self, specs: list[RolloutSpec]) -> list[RolloutSpec]:
        """
        Its share of the flights of a study.

        Raises:
            ValueError: if there are fewer places than shards.
        """
        places = list(dict.fromkeys((spec.scenario, spec.seed) for spec in specs))
        if self.total > len(places):
            raise ValueError(
                f"the study has {len(places)} places to fly in, a scenario and seed each, and "
                f"cannot be dealt out to {self.total} shards; make it {len(places)} at most"
            )
        mine = set(places[self.number - 1 :: self.total])
        return [spec for spec in specs if (spec.scenario, spec.seed) in mine]
