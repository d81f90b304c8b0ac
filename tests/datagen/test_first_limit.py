"""The limit that a plan meets first."""

from datagen.first_limit import first_limit, machine_memory

WITHIN = {
    "needed": 1e9,
    "free": 2e9,
    "memory": 1e9,
    "workers": 2,
    "here": True,
    "seconds": 1e4,
    "written": 1e9,
}


def test_the_first_limit_is_space_then_memory_then_storage_then_processors() -> None:
    assert first_limit(**WITHIN).startswith(
        "processors: a worker writes 0.1 MB/s; storage of 100 MB/s would bind"
    )
    assert first_limit(**{**WITHIN, "written": 1e12}).startswith("storage")
    crowded = {**WITHIN, "written": 1e12, "memory": machine_memory() * 0.6}
    assert "1 fit" in first_limit(**crowded)
    assert first_limit(**{**crowded, "here": False}).startswith("storage")
    assert first_limit(**{**crowded, "needed": 3e9}).startswith("space: 1 GB are missing")


def test_nothing_binds_where_nothing_is_missing() -> None:
    assert first_limit(**{**WITHIN, "needed": 0, "seconds": 0, "written": 0}).startswith("nothing")
