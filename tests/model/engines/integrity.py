"""Whether the requests and the memory of a decoder agree with each other."""

from __future__ import annotations

from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.request import Phase


def check_integrity(decoder: Decoder) -> None:
    """Raise `AssertionError` where something is held twice, for nobody, or by somebody who should not.

    Nothing but tests looks into a decoder's books, so it has no public word for them.
    """
    requests, memory = decoder._scheduler.requests, decoder._memory
    trees = [tree for request in requests for tree in request.trees]
    rows = [row for tree in trees for row in tree.rows]
    for kind, pool, used in (
        ("KV rows", memory.kv_rows, [tree.kv_row for tree in trees if tree.kv_row is not None]),
        ("entries", memory.entries, [row.entry for row in rows if row.entry is not None]),
    ):
        assert len(used) == len(set(used)), f"{kind} are used twice"
        assert len(used) == pool.size - pool.free, f"{kind} are held for nobody"
    draws = [(row.request.id, draw, row.draft) for row in rows for draw in row.draws]
    assert len(draws) == len(set(draws)), "a draw runs twice"
    for request in requests:
        assert request.phase is not Phase.ENDED, "a request is kept that has ended"
        assert request.trees, "a request has nothing to do"
        assert len(list(request.rows)) <= request.most_rows, "a request uses more than it reserved"
        undecided = {draw for row in request.rows if not row.draft for draw in row.draws}
        assert request.drafts.keys() <= undecided, "a draft is kept for nobody"
    for tree in trees:
        assert tree.rows, "a tree has no rows"
        assert tree.kv_row is None or tree.request.phase is Phase.RUNNING, "a waiting request has memory"
        assert tree.prompt is None or tree.prompt.kv_row == tree.kv_row, "a prompt lies elsewhere"
    for row in rows:
        assert row.draws, "a row is nobody's"
        assert (row.entry is None) == (row.tree.kv_row is None), "a row has memory without its tree"
        if row.tree.decoding:
            assert row.pending or row.cursor.done, "a row has nothing to feed"
