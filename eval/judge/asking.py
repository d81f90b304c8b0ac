"""Ask many questions in parallel, and store each answer as it arrives."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence

from eval.judge.answers import LONGEST_TEXT, Answers, Stored, answer_key
from eval.judge.endpoint import Endpoint, NoAnswer
from eval.judge.prompt import Answer
from eval.judge.schedule import Question
from tron.errors import TronError

log = logging.getLogger("tron.eval")

PATIENCE = 3
"""Questions in a row that an endpoint may leave without an answer."""
SAID_EVERY = 30.0
"""Seconds between two lines of progress."""

Picture = Callable[[Question, str], bytes]
"""A question and one of its two methods -> its picture, PNG."""
Found = Mapping[Question, Answer | None]
"""Question -> its answer, None where the judge said none of A, B and TIE."""


def replay(
    asked: Iterable[Question], picture: Picture, model: str, answers: Answers
) -> dict[Question, Answer | None]:
    """Return the stored answers to questions; questions without a stored answer are left out."""
    found = {}
    for question in asked:
        stored = answers.get(
            answer_key(model, question, picture(question, question.first), picture(question, question.second))
        )
        if stored is not None:
            found[question] = stored.answer
    return found


def ask_all(
    asked: Sequence[Question], picture: Picture, endpoint: Endpoint, answers: Answers, parallel: int
) -> dict[Question, Answer | None]:
    """Ask the unanswered questions, ``parallel`` at a time, and return all answers.

    Raises:
        TronError: the endpoint refuses, or left PATIENCE questions in a row without an answer; earlier
            answers are kept.
    """
    with answers.appending():
        return asyncio.run(_ask_all(asked, picture, endpoint, answers, parallel))


async def _ask_all(
    asked: Sequence[Question], picture: Picture, endpoint: Endpoint, answers: Answers, parallel: int
) -> dict[Question, Answer | None]:
    todo, found, failures = iter(asked), dict[Question, Answer | None](), list[str]()
    said_at = time.monotonic()

    async def work(client: object) -> None:
        nonlocal said_at
        for question in todo:
            first, second = picture(question, question.first), picture(question, question.second)
            key = answer_key(endpoint.model, question, first, second)
            stored = answers.get(key)
            if stored is None:
                try:
                    answer, text = await endpoint.ask(client, question.seed, first, second)
                except NoAnswer as error:
                    failures.append(str(error))
                    if len(failures) >= PATIENCE:
                        raise _gave_up(endpoint, failures[-1], len(found), len(asked)) from error
                    continue
                failures.clear()
                stored = Stored(
                    key=key,
                    **vars(question),
                    answer=answer,
                    text=text[:LONGEST_TEXT],
                    model=endpoint.model,
                )
                answers.add(stored)
            found[question] = stored.answer
            if time.monotonic() - said_at > SAID_EVERY:
                said_at = time.monotonic()
                log.info("judge: %d of %d questions answered", len(found), len(asked))

    async with endpoint.client() as client:
        try:
            async with asyncio.TaskGroup() as group:
                for _ in range(parallel):
                    group.create_task(work(client))
        except ExceptionGroup as group:
            told = group.subgroup(TronError)
            raise (told or group).exceptions[0] from None
    if len(found) < len(asked):
        raise _gave_up(endpoint, failures[-1] if failures else "no reply", len(found), len(asked))
    return found


def _gave_up(endpoint: Endpoint, why: str, answered: int, asked: int) -> TronError:
    return TronError(
        f"the judge leaves questions without an answer: {why}; {answered} of {asked} answers are kept",
        endpoint.url,
        "give the same command again, which asks for the others",
    )
