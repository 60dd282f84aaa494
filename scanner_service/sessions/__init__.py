"""A live scan session: its engine thread, its ledger of losses and its fan-out to clients."""
