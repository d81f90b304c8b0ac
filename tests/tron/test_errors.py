"""TronError is one line that says what, where and how to mend it, also across processes."""

import pickle

from tron.errors import TronError


def test_message_is_one_line_with_what_where_and_mend():
    error = TronError("file\nnot found", "/data/a.ply", "give\n another path")
    assert str(error) == "file not found (/data/a.ply): give another path"


def test_place_and_remedy_may_be_unknown():
    assert str(TronError("disk is full")) == "disk is full"
    assert str(TronError("disk is full", mend="free some space")) == "disk is full: free some space"


def test_error_survives_the_way_back_from_a_worker():
    copy = pickle.loads(pickle.dumps(TronError("a", "b", "c")))
    assert (copy.what, copy.where, copy.mend, str(copy)) == ("a", "b", "c", "a (b): c")
