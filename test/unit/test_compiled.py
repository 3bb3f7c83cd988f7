"""Where machine code is kept, and how functions are put into others with old versions of numba."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from eskf_ros import compiled

pytestmark = pytest.mark.skipif(not compiled.COMPILED, reason="numba is not installed or switched off")


def test_what_the_build_has_compiled_is_used_in_a_cache_that_is_not_there_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NUMBA_CACHE_DIR may name a folder that nobody has made."""
    built, cache = tmp_path / "machine_code", tmp_path / "not" / "there"
    (built / "filter.loop.0123").mkdir(parents=True)
    (built / "filter.loop.0123" / "advance.nbi").write_bytes(b"code")
    monkeypatch.setattr(compiled, "BUILT", built)
    monkeypatch.setattr(compiled, "CACHE_FOLDER", cache)
    assert (compiled._folder_of("filter.loop", "0123") / "advance.nbi").read_bytes() == b"code"
    assert sorted(entry.name for entry in cache.iterdir()) == ["filter.loop.0123"]


def test_the_statements_of_a_block_share_one_table_of_variables() -> None:
    """Each has its own in numba 0.58: the work grows with the square of the size of a function."""
    from numba.core import ir

    place = ir.Loc("nowhere", 1)
    scope = ir.Scope(None, place)
    variables = [scope.define(name, place) for name in "abc"]
    block = ir.Block(scope, place)
    for a, b in itertools.pairwise(variables):
        block.append(ir.Assign(a, b, place))
    copier = compiled._CopyWithOneScope()
    copied = copier.deepcopy(block)
    assert copied.scope is not scope
    for statement in block.body:
        target = copier.deepcopy(statement).target
        assert target.scope is copied.scope
        assert target is not statement.target


def test_numba_copies_as_it_does_by_itself_once_we_have_compiled() -> None:
    import copy

    from numba.core import inline_closurecall

    with compiled._frugally(), compiled._frugally():
        assert inline_closurecall.copy is not copy
    assert inline_closurecall.copy is copy


def test_processes_that_start_together_may_remove_the_same_old_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each removes the code of old versions of a module, while the other looks at it."""
    monkeypatch.setattr(compiled, "CACHE_FOLDER", tmp_path)
    for round_ in range(20):
        for k in range(100):
            (tmp_path / f"filter.loop.{round_}-{k}").mkdir()
        with ThreadPoolExecutor(4) as threads:
            for done in [threads.submit(compiled._prune, "filter.loop") for _ in range(4)]:
                done.result()
    assert 0 < len(list(tmp_path.iterdir())) < compiled.KEPT_VERSIONS
