"""How a pass of a rig is driven, and what becomes of its profiles; knows faces of scanners and stages, no device."""
