"""How fast the service is, measured beside the tools that people use today; runs from a checkout only."""
