"""`python -m scanner_service`: the same as the `scanner` command."""

from scanner_service.cli import main

main()
