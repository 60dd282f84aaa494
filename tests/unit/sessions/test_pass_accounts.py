"""The account of each pass balances at any moment, and again after the service ended at any moment."""

import json

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.tally import ChunkTally, LineTally, PassTally
from scanner_service.sessions.ledger import Ledger

KEYS = [("A", 1, 0), ("A", 1, 1), ("B", 2, 0)]
FATES = st.sampled_from(["stored", "stored", "duplicate", "conflict", "record_busy", "not_stored"])
STEPS = st.lists(st.tuples(st.sampled_from(range(3)), FATES | st.none(), st.booleans()), max_size=60)


@settings(max_examples=300, deadline=None)
@given(STEPS, st.integers(0, 60), st.booleans())
def test_sent_is_stored_under_way_and_lost_for_each_pass_also_after_a_restart(steps, kept_after, on_a_wire):
    ledger, stored, partial = Ledger(), dict.fromkeys(KEYS, 0), dict.fromkeys(KEYS, 0)
    arrived, kept = dict.fromkeys(KEYS, 0), None

    def wire():
        """A driver that lost one line in each pass and holds two that did not reach the session yet."""
        if not on_a_wire:
            return None
        return {
            key: PassTally(ChunkTally(2, 1, {"missing": 1}), LineTally(count + 3, count + 2, 0, 0, {"damaged": 1}))
            for key, count in arrived.items()
        }

    for number, (at, fate, is_partial) in enumerate(steps):
        key = KEYS[at]
        ledger.arrived(key)
        arrived[key] += 1
        if fate is not None:
            ledger.decided(fate, key, is_partial)
            stored[key] += fate == "stored"
            partial[key] += fate == "stored" and is_partial
        assert all(account.balances for account in ledger.passes(wire()).values())
        if number == kept_after:
            kept = json.loads(json.dumps(ledger.to_dict(None, wire())))
    for key, account in ledger.passes(wire()).items():
        assert (account.stored, account.partial) == (stored[key], partial[key])
        if on_a_wire:
            assert account.sent == arrived[key] + 3

    again = Ledger()
    again.reopened(kept, {key: count for key, count in stored.items() if count}, partial)
    accounts = again.passes()
    assert all(account.balances and account.under_way == 0 for account in accounts.values())
    assert {key: account.stored for key, account in accounts.items() if account.stored} == {
        key: count for key, count in stored.items() if count
    }
    lines = again.to_dict()["lines"]
    assert lines["received"] == lines["stored"] + lines["duplicates"] + lines["conflicts"] + sum(
        lines["refused"].values()
    )
    assert lines["stored"] == sum(stored.values())
    once_more = Ledger()
    once_more.reopened(json.loads(json.dumps(again.to_dict())), stored, partial)
    assert {k: a for k, a in once_more.passes().items() if a.sent} == {k: a for k, a in accounts.items() if a.sent}
