"""Benchmark `judge`: the paper's A/B comparison by a vision model."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from eval.benchmark import Benchmark
from eval.judge.answers import Answers
from eval.judge.asking import Found, ask_all, replay
from eval.judge.endpoint import Endpoint, require_openai
from eval.judge.schedule import Question, controls, questions
from eval.judge.verdicts import Fitness, rival_rows
from eval.report.outcome import Outcome
from eval.results import Row
from tron.errors import TronError
from tron.io.images import decode_png
from tron.report.page import Picture, Pictures

if TYPE_CHECKING:
    from eval.judge.sent import Sent
    from eval.protocol.method import MethodFolder
    from eval.protocol.suite import Suite

log = logging.getLogger("tron.eval")

ANSWERS, SENT = "answers.jsonl", "sent"


class Judge(Benchmark):
    """Settings: methods of a suite to judge in pairs, and the judge."""

    name: ClassVar[str] = "judge"

    suite: Path | None = Field(
        description="folder written by tron-eval export=SUITE; null: only judges with known answers"
    )
    methods: Path | list[Path] | None = Field(description="folder of methods' folders, or [a,b]")
    ours: str | None = Field(description="name of the method to compare with all others")
    judge: Literal["endpoint", "replay"] = Field(
        description="endpoint: ask the model and store its answers; replay: use stored answers only"
    )
    endpoint: str | None = Field(
        description="address of an OpenAI-compatible API, such as https://api.openai.com/v1; pictures of the "
        "methods are sent there"
    )
    model: str | None = Field(description="name of a vision model at this address")
    key_variable: str = Field(description="environment variable with the API key, never written to a file")
    answers: Path | None = Field(
        description="file of stored answers, which are reused; null: answers.jsonl in output_dir"
    )
    views: PositiveInt = Field(description="number of views drawn per scene and light")
    seeds: list[int] = Field(
        description="one round per seed; it draws the views and is sent to the judge", min_length=1
    )
    parallel: PositiveInt = Field(description="number of questions in flight", le=64)
    timeout: PositiveFloat = Field(description="time limit of one try, seconds")
    retries: NonNegativeInt = Field(description="further tries after a missing or invalid answer", le=20)
    seed: int = Field(default=0, description="seed of the control pairs and of the order of questions")

    def check(self) -> None:
        """Check that all settings for judging methods are given, before anything is asked."""
        if self.judge == "endpoint" or self.suite is None:
            require_openai()
        if self.suite is None:
            return
        for name in ("methods", "ours", "model"):
            if getattr(self, name) is None:
                mend = "give methods=DIR benchmark.ours=NAME benchmark.endpoint=URL benchmark.model=NAME"
                raise TronError(f"suite needs {name} too", mend=mend)
        if self.judge == "endpoint":
            self._endpoint().check()
        elif self.answers is None or not self.answers.is_file():
            mend = "give benchmark.answers=FILE, the answers.jsonl of a run that asked"
            raise TronError("no stored answers to replay", self.answers, mend)
        self._read()

    def run(self, output_dir: Path) -> Outcome:
        """Ask judges with known answers, then the judge about control pairs, then about methods if it is fit.

        Raises:
            TronError: a folder is not what it should be, or the endpoint does not answer; its answers are
                kept, and the same command resumes.
        """
        outcome = Outcome(output_dir)
        if self.judge == "endpoint" or self.suite is None:
            from eval.judge.loopback import BY_PSNR, check_rows  # asks, too

            outcome.add(check_rows(output_dir, self.seed))
            if self.suite is None:
                known = next(row for row in outcome.rows if row.metric.endswith(f"{BY_PSNR}.control_won"))
                outcome.add([Row(metric="judge.control_won", value=known.value, unit="1", n=known.n)])
                outcome.lack("judge.win_rate", "no suite, methods and judge were given")
                return outcome
        self._judge_methods(outcome)
        return outcome

    def _read(self) -> tuple[Suite, dict[str, MethodFolder | None]]:
        """Read the suite, the methods and the truth; TronError if ours is missing, or has no rival."""
        from eval.compare.displayed import methods_and_truth
        from eval.protocol.suite import Suite

        assert self.suite is not None
        assert self.methods is not None
        suite = Suite.load(self.suite)
        folders = methods_and_truth(self.methods, suite)
        if folders.get(self.ours or "") is None:
            there = ", ".join(name for name, folder in folders.items() if folder is not None)
            raise TronError(f"no method {self.ours}; there are {there}", str(self.methods))
        if len(folders) == 1:
            mend = "add another method's folder"
            raise TronError(f"nothing to hold {self.ours} against", str(self.methods), mend)
        return suite, folders

    def _endpoint(self) -> Endpoint:
        if not self.endpoint:
            raise TronError("suite needs a judge", mend="set benchmark.endpoint=https://HOST/v1")
        return Endpoint(self.endpoint, self.model or "", self.key_variable, self.timeout, self.retries)

    def _judge_methods(self, outcome: Outcome) -> None:
        from eval.judge.sent import Sent

        assert self.ours is not None
        suite, folders = self._read()
        rivals = [name for name in folders if name != self.ours]
        scenes = {name: (list(each.lights), each.entry.frames) for name, each in suite.scenes.items()}
        of_control = controls(scenes, self.seed)
        asked = questions(scenes, self.ours, rivals, self.views, self.seeds)
        sent = Sent(outcome.folder / SENT)
        faults = sent.write(suite, folders, self.ours, [*of_control, *asked])
        if self.ours in faults:
            raise TronError(faults[self.ours], mend=f"without all pictures of {self.ours} nothing is asked")
        outcome.inputs |= {"suite": suite.id, "methods": list(folders), "judge": self.model}
        for rival in faults:
            outcome.lack(f"judge.win_rate.{rival}", faults[rival])
        asked = [each for each in asked if not {each.first, each.second} & set(faults)]
        self._ask(outcome, sent, of_control, asked, [each for each in rivals if each not in faults])

    def _ask(
        self,
        outcome: Outcome,
        sent: Sent,
        of_control: Sequence[Question],
        asked: Sequence[Question],
        rivals: Sequence[str],
    ) -> None:
        assert self.ours is not None
        answers = Answers(self.answers or outcome.folder / ANSWERS)
        found = dict(self._answers(of_control, sent, answers))
        if len(found) < len(of_control):
            said = f"{len(of_control) - len(found)} answers to control pairs are not stored"
            mend = "replay with the suite, methods and model of the run that asked"
            raise TronError(said, answers.path, mend)
        fitness = Fitness.of(found)
        if not fitness.faults():
            log.info("%d questions about methods, %d answers are stored", len(asked), len(answers))
            found |= self._answers(asked, sent, answers)
            missing = {
                rival: sum(rival in (each.first, each.second) and each not in found for each in asked)
                for rival in rivals
            }
            for rival in rivals:
                if missing[rival]:
                    outcome.lack(f"judge.win_rate.{rival}", f"{missing[rival]} answers are not stored")
            rivals = [each for each in rivals if not missing[each]]
            both: Found = {each: answer for each, answer in found.items() if each.swapped() in found}
            fitness = Fitness.of(both)
        outcome.add(fitness.rows())
        if faults := fitness.faults():
            for rival in rivals:
                outcome.lack(f"judge.win_rate.{rival}", f"the judge is unfit: {', '.join(faults)}")
            return
        for rival in rivals:
            outcome.add(rival_rows(found, self.ours, rival, self.seeds, self.seed))
            first = next(each for each in asked if each.first == self.ours and each.second == rival)
            outcome.show("wins", f"judge-{rival}", _pair(first, sent, found))

    def _answers(self, asked: Sequence[Question], sent: Sent, answers: Answers) -> Found:
        if self.judge == "replay":
            return replay(asked, sent, self.model or "", answers)
        return ask_all(asked, sent, self._endpoint(), answers, self.parallel)


def _pair(question: Question, sent: Sent, found: Found) -> Pictures:
    """Show a pair as the judge saw it, with its answers in both orders."""
    said = [found[question], found[question.swapped()]]
    title = (
        f"{question.scene}, {question.light}, view {question.view}: {said[0]}, in the other order {said[1]}"
    )
    pictures = [
        Picture(decode_png(sent(question, method)), f"{letter}: {method}", f"{title}: {method}")
        for letter, method in (("A", question.first), ("B", question.second))
    ]
    return Pictures(title, pictures, columns=2)
