"""What the command line can do, one file a command; the composition root `cli.py` lists them."""
