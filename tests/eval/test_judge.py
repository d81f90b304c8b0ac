"""The judge: schedule, statistics, and real servers that answer well, by position, badly or never."""

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eval.cli import cli
from eval.judge.answers import Answers
from eval.judge.asking import PATIENCE, ask_all, replay
from eval.judge.endpoint import Endpoint
from eval.judge.loopback import BETTER, WORSE, Handler, by_psnr, made_pictures, serving
from eval.judge.prompt import read_answer
from eval.judge.schedule import Question, controls, pairs, questions, spoiled
from eval.judge.verdicts import Fitness, rival_rows
from eval.results import Results
from tron.errors import TronError

pytest.importorskip("openai")

TRUTH, PICTURE = made_pictures(0)
SCENES = {"made": (["lamp"], len(TRUTH))}
ASKED = controls(SCENES, 0)[:4] + questions(SCENES, BETTER, [WORSE], 3, [0, 1])
VARIABLE = "TRON_TEST_JUDGE_KEY"
KEY = "sk-a-secret"


def endpoint(url: str, timeout: float = 30.0, retries: int = 1) -> Endpoint:
    return Endpoint(url, "model", VARIABLE, timeout, retries)


class Counting(Handler):
    """Counts what it is asked."""

    asked = 0
    lock = threading.Lock()
    judge = staticmethod(by_psnr(list(TRUTH)))

    def do_POST(self) -> None:
        with self.lock:
            type(self).asked += 1
        super().do_POST()


@pytest.fixture
def counting() -> type[Counting]:
    return type("Fresh", (Counting,), {"asked": 0})


def saying(judge: Callable[..., str]) -> type[Counting]:
    return type("Saying", (Counting,), {"asked": 0, "judge": staticmethod(judge)})


def test_replies_are_one_token():
    assert [read_answer(text) for text in ("A", " b.\n", '"TIE"', "**A**")] == ["A", "B", "TIE", "A"]
    assert read_answer("<think>A or B?\nB has shadows.</think>\nB") == "B"
    for text in ("", "AB", "A B", "I think A", "C", "neither", "None"):
        assert read_answer(text) is None, text


def test_the_papers_protocol_is_495_pairs_a_rival_and_seed():
    scenes = {f"s{k}": (["a", "b", "c"], 40) for k in range(33)}
    asked = questions(scenes, "ours", ["x", "y"], 5, [0, 1, 2])
    assert len(asked) == len(set(asked)) == 495 * 2 * 2 * 3
    assert len(list(pairs(asked))) == 495 * 2 * 3
    views = {(q.scene, q.light, q.seed, r): set() for q in asked for r in "xy"}
    for q in asked:
        views[q.scene, q.light, q.seed, ({q.first, q.second} - {"ours"}).pop()].add(q.view)
    assert {len(each) for each in views.values()} == {5}
    assert all(found == views[(*key[:3], "y")] for key, found in views.items()), "rivals share views"
    assert len({tuple(sorted(views[q.scene, q.light, q.seed, "x"])) for q in asked}) > 100, "drawn"
    assert asked == questions(scenes, "ours", ["x", "y"], 5, [0, 1, 2])
    with pytest.raises(ValueError, match="one order alone"):
        list(pairs(asked[:-1]))


def test_spoiled_pictures_keep_their_mean_and_lose_their_detail():
    image = np.random.Generator(np.random.PCG64(0)).uniform(size=(50, 70, 3))
    blocks = spoiled(image)
    assert blocks.shape == image.shape
    np.testing.assert_allclose(blocks[:3, :3], np.broadcast_to(image[:3, :3].mean((0, 1)), (3, 3, 3)))
    np.testing.assert_allclose(blocks[48:, 69:], np.broadcast_to(image[48:, 69:].mean((0, 1)), (2, 1, 3)))


def test_a_judge_by_psnr_is_fit_and_is_not_asked_twice(tmp_path: Path, counting: type[Counting]):
    answers = Answers(tmp_path / "answers.jsonl")
    with serving(counting) as url:
        found = ask_all(ASKED, PICTURE, endpoint(url), answers, 3)
        assert counting.asked == len(ASKED)
        again = ask_all(ASKED, PICTURE, endpoint(url), Answers(answers.path), 3)
    assert counting.asked == len(ASKED), "what was answered is not asked again"
    assert again == found
    fitness = Fitness.of(found)
    assert not fitness.faults()
    assert fitness.controls == fitness.same == 1
    rows = {row.metric: row for row in rival_rows(found, BETTER, WORSE, [0, 1], 0)}
    assert rows[f"judge.win_rate.{WORSE}"].value == 1
    assert rows[f"judge.win_rate.{WORSE}"].n == 12
    assert rows[f"judge.win_rate_deviation.{WORSE}"].value == 0
    assert replay(ASKED, PICTURE, "model", Answers(answers.path)) == found
    assert replay(ASKED, PICTURE, "another model", Answers(answers.path)) == {}


def test_other_pictures_are_other_questions(tmp_path: Path, counting: type[Counting]):
    other = made_pictures(1)[1]
    with serving(counting) as url:
        for picture in (PICTURE, other, PICTURE):
            ask_all(ASKED[-2:], picture, endpoint(url), Answers(tmp_path / "a.jsonl"), 1)
    assert counting.asked == 4


@pytest.mark.parametrize("letter", ["A", "B"])
def test_a_judge_by_position_is_found_out(tmp_path: Path, letter: str):
    with serving(saying(lambda *_: letter)) as url:
        found = ask_all(ASKED, PICTURE, endpoint(url), Answers(tmp_path / "answers.jsonl"), 2)
    fitness = Fitness.of(found)
    assert fitness.by_position
    assert not fitness.control_won
    assert any("position" in fault for fault in fitness.faults())
    (won, *_) = rival_rows(found, BETTER, WORSE, [0, 1], 0)
    assert won.value == 0.5, "a place that is preferred gives neither method anything"


def test_a_judge_that_errs_at_random_does_not_answer_by_position():
    draw = np.random.Generator(np.random.PCG64(4))
    asked = questions({"s": (["a", "b"], 100)}, "x", ["y"], 100, [0])
    fitness = Fitness.of({each: draw.choice(["A", "B", "TIE"]) for each in asked})
    assert not fitness.by_position
    assert fitness.same == pytest.approx(1 / 3, abs=0.1)


def test_ties_are_half_a_win():
    asked = questions({"s": (["a"], 4)}, "x", ["y"], 4, [0])
    rows = {row.metric: row.value for row in rival_rows(dict.fromkeys(asked, "TIE"), "x", "y", [0], 0)}
    assert rows == {"judge.win_rate.y": 0.5, "judge.ties.y": 1.0}


def test_garbage_is_asked_for_again_then_counted_and_makes_the_judge_unfit(tmp_path: Path):
    handler = saying(lambda *_: "Both are lovely.")
    with serving(handler) as url:
        found = ask_all(ASKED[:4], PICTURE, endpoint(url), Answers(tmp_path / "answers.jsonl"), 1)
    assert handler.asked == 8
    assert set(found.values()) == {None}
    assert "none of A, B and TIE" in Fitness.of(found).faults()[0]
    stored = [json.loads(line) for line in (tmp_path / "answers.jsonl").read_text().splitlines()]
    assert [each["text"] for each in stored] == ["Both are lovely."] * 4


@pytest.mark.parametrize(
    "body", [b"<html>", b"[]", b'{"choices": []}', b'{"choices": 3}', b"\xff\xfe", b"[" * 9999]
)
def test_what_is_no_completion_is_garbage(tmp_path: Path, body: bytes):
    class Lying(Counting):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

    with serving(Lying) as url:
        found = ask_all(ASKED[:2], PICTURE, endpoint(url, retries=0), Answers(tmp_path / "a.jsonl"), 1)
    assert set(found.values()) == {None}


def test_a_server_that_comes_too_late_ends_in_one_line_and_keeps_what_it_said(tmp_path: Path):
    class Late(Counting):
        def do_POST(self) -> None:
            if type(self).asked >= 3:
                time.sleep(1.5)
            super().do_POST()

    answers = Answers(tmp_path / "answers.jsonl")
    start = time.monotonic()
    with serving(Late) as url, pytest.raises(TronError, match=r"no reply within 0.4 s.*3 of 10 answers"):
        ask_all(ASKED[:10], PICTURE, endpoint(url, timeout=0.4), answers, 1)
    assert time.monotonic() - start < PATIENCE * 20
    assert len(Answers(answers.path)) == 3


@pytest.mark.parametrize("endless", [False, True], ids=["drips", "floods"])
def test_a_server_that_never_ends_is_left(tmp_path: Path, endless: bool):
    class Endless(Counting):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.end_headers()
            try:
                for _ in range(100_000):
                    self.wfile.write(b" " * 2**16 if endless else b" ")
                    time.sleep(0 if endless else 0.1)
            except OSError:
                pass

    said = "longer than" if endless else "no reply within"
    with serving(Endless) as url, pytest.raises(TronError, match=said):
        ask_all(
            ASKED[:6], PICTURE, endpoint(url, timeout=0.5 if not endless else 30), Answers(tmp_path / "a"), 3
        )


def test_a_server_that_refuses_is_one_line_at_once_without_the_key(tmp_path: Path, monkeypatch):
    monkeypatch.setenv(VARIABLE, KEY)

    class Refusing(Counting):
        def do_POST(self) -> None:
            type(self).asked += 1
            assert self.headers["Authorization"] == f"Bearer {KEY}"
            self.rfile.read(int(self.headers["Content-Length"]))
            self.reply({"error": {"message": f"wrong key {KEY}"}}, 401)

    with serving(Refusing) as url, pytest.raises(TronError, match="refuses: 401") as told:
        ask_all(ASKED, PICTURE, endpoint(url), Answers(tmp_path / "a"), 1)
    assert Refusing.asked == 1
    assert VARIABLE in str(told.value)
    assert KEY not in str(told.value)
    assert KEY not in (tmp_path / "a").read_text()


def test_a_server_that_is_busy_is_asked_again(tmp_path: Path):
    class Busy(Counting):
        def do_POST(self) -> None:
            type(self).asked += 1
            if type(self).asked % 2:
                self.rfile.read(int(self.headers["Content-Length"]))
                self.reply({"error": {"message": "busy"}}, 429)
            else:
                Handler.do_POST(self)

    with serving(Busy) as url:
        found = ask_all(ASKED[:2], PICTURE, endpoint(url), Answers(tmp_path / "a"), 1)
    assert Busy.asked == 4
    assert None not in found.values()


def test_no_server_is_one_line(tmp_path: Path):
    with serving(Counting) as url:
        pass
    with pytest.raises(TronError, match=r"no connection.*0 of 4 answers"):
        ask_all(ASKED[:4], PICTURE, endpoint(url, retries=0), Answers(tmp_path / "a"), 2)


@pytest.mark.parametrize(
    "url, said",
    [
        ("api.openai.com/v1", "not an address"),
        ("https://me:pw@host/v1", "holds a key"),
        ("https://host/v1?key=1", "holds a key"),
    ],
)
def test_addresses_that_are_none_or_hold_a_key_are_refused(url: str, said: str):
    with pytest.raises(TronError, match=said):
        endpoint(url).check()


def test_a_line_that_was_cut_off_is_asked_again_and_others_stay(tmp_path: Path, counting: type[Counting]):
    path = tmp_path / "answers.jsonl"
    with serving(counting) as url:
        ask_all(ASKED[:4], PICTURE, endpoint(url), Answers(path), 1)
        path.write_bytes(path.read_bytes()[:-20])
        assert len(Answers(path)) == 3
        ask_all(ASKED[:4], PICTURE, endpoint(url), Answers(path), 1)
    assert counting.asked == 5
    assert len(Answers(path)) == 4
    path.write_text(path.read_text().replace('"view"', '"eye"', 1))
    with pytest.raises(TronError, match="line 1 is not an answer"):
        Answers(path)


def test_the_benchmark_holds_itself_to_known_judges(tmp_path: Path):
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=judge", f"output_dir={tmp_path}"])
    assert not end.value.code
    results = Results.load(tmp_path / "results.json")
    assert results.value("judge.position_bias_found") == 1
    assert results.value("judge.control_won") == 1
    assert "by position" in (tmp_path / "report.html").read_text()


def test_questions_are_hashable_and_swap_back():
    one = Question("s", "l", 0, 0, "x", "y")
    assert one.swapped().swapped() == one != one.swapped()
