"""Turn answers into figures: win rates, and the fitness of the judge."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats

from eval.judge.asking import Found
from eval.judge.prompt import Answer
from eval.judge.schedule import CONTROL, Question, pairs
from eval.results import Row, mean_row

CONTROL_SHARE = 0.75
"""Control pairs that must be won in both orders; who guesses wins a quarter."""
BIAS, BIAS_P = 0.25, 0.01
"""A judge answers by position if so much larger a share of pairs is "A" in both orders than "B" in both, or
the other way, and chance does it in fewer than one run of a hundred."""
MOST_GARBAGE = 0.05
"""Share of answers that may be none of A, B and TIE."""
UNITS = {"control_won": "1", "fit": "1", "position_bias": "1", "position_bias_p": "abs"}
"""Of the judge's figures; the others are shares."""
LEAST_SCENES = 6
"""Scenes from which Wilcoxon's test can find anything at all."""


def share_won(question: Question, answer: Answer, method: str) -> float:
    """Return 1 if the method's picture was chosen, 0 if the other was, 0.5 for a tie."""
    return {"TIE": 0.5, "A": float(question.first == method), "B": float(question.second == method)}[answer]


@dataclass(frozen=True)
class Fitness:
    """Fitness of a judge, independent of its verdicts on methods.

    Attributes:
        controls: share of control pairs that were won in both orders.
        bias: share of pairs answered "A" in both orders less that of "B" in both, -1 to 1.
        bias_p: how often chance makes as many more of the one than of the other (exact binomial test).
        same: share of pairs whose two orders were answered alike.
        garbage: share of answers that were none of A, B and TIE.
        n: pairs, those of the control among them.
    """

    controls: float
    bias: float
    bias_p: float
    same: float
    garbage: float
    n: int

    @property
    def control_won(self) -> bool:
        """Whether the judge tells a picture from its pixelated copy."""
        return self.controls >= CONTROL_SHARE

    @property
    def by_position(self) -> bool:
        """Whether the judge answers by position."""
        return abs(self.bias) >= BIAS and self.bias_p < BIAS_P

    def faults(self) -> list[str]:
        """Reasons why the judge is unfit, in words; empty if it is fit."""
        return [
            words
            for wrong, words in (
                (self.garbage > MOST_GARBAGE, f"{self.garbage:.0%} of its answers are none of A, B and TIE"),
                (self.by_position, f"it answers by position (bias {self.bias:+.2f})"),
                (not self.control_won, f"it won {self.controls:.0%} of the control pairs"),
            )
            if wrong
        ]

    @classmethod
    def of(cls, found: Found) -> Fitness:
        """Measure by all answers, including answers to control pairs."""
        both: list[tuple[Question, Answer | None, Answer | None, Question]] = [
            (one, found[one], found[other], other) for one, other in pairs(list(found))
        ]
        names = [(one, other) for _, one, other, _ in both]
        of_control = [
            share_won(one, a, CONTROL) + share_won(other, b, CONTROL) == 2 if a and b else False
            for one, a, b, other in both
            if CONTROL in (one.first, one.second)
        ]
        firsts, seconds = names.count(("A", "A")), names.count(("B", "B"))
        flips = firsts + seconds
        p = scipy.stats.binomtest(firsts, flips).pvalue if flips else 1.0
        same = sum((one, other) in (("A", "B"), ("B", "A"), ("TIE", "TIE")) for one, other in names)
        return cls(
            controls=float(np.mean(of_control)) if of_control else 0.0,
            bias=(firsts - seconds) / len(both),
            bias_p=float(p),
            same=same / len(both),
            garbage=sum(answer is None for answer in found.values()) / len(found),
            n=len(both),
        )

    def rows(self, prefix: str = "judge") -> Iterator[Row]:
        """Yield rows of the judge's fitness; ``prefix`` names the judge."""
        figures = {
            "control_share": self.controls,
            "control_won": float(self.control_won),
            "position_bias": self.bias,
            "position_bias_p": self.bias_p,
            "same_both_ways": self.same,
            "garbage": self.garbage,
            "fit": float(not self.faults()),
        }
        for name, value in figures.items():
            unit = UNITS.get(name, "fraction")
            yield Row(metric=f"{prefix}.{name}", value=value, unit=unit, n=self.n)


def rival_rows(found: Found, ours: str, rival: str, seeds: Sequence[int], seed: int) -> Iterator[Row]:
    """Yield our win rate over a rival, its deviation over seeds, ties, and Wilcoxon's test over scenes.

    Ties are half a win; invalid answers are left out, and ``n`` counts valid ones.
    """
    said: dict[Question, Answer] = {
        question: answer
        for question, answer in found.items()
        if answer is not None and {question.first, question.second} == {ours, rival}
    }
    won = [(each.scene, share_won(each, answer, ours)) for each, answer in said.items()]
    yield mean_row(f"judge.win_rate.{rival}", "fraction", won, seed)
    n = len(said)
    ties = sum(answer == "TIE" for answer in said.values()) / n
    yield Row(metric=f"judge.ties.{rival}", value=ties, unit="fraction", n=n)
    rounds = [[share_won(q, a, ours) for q, a in said.items() if q.seed == each] for each in seeds]
    means = [np.mean(each) for each in rounds if each]
    if len(means) > 1:
        deviation = float(np.std(means, ddof=1))
        yield Row(metric=f"judge.win_rate_deviation.{rival}", value=deviation, unit="fraction", n=len(means))
    names = sorted({scene for scene, _ in won})
    if len(names) >= LEAST_SCENES:
        by_scene = [np.mean([w for scene, w in won if scene == name]) - 0.5 for name in names]
        p = float(np.asarray(scipy.stats.wilcoxon(by_scene))[1]) if np.any(by_scene) else 1.0
        yield Row(metric=f"judge.win_rate_p.{rival}", value=p, unit="abs", n=len(names))
