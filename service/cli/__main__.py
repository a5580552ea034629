"""`python -m service.cli` is `looktwice`."""

from service.cli import main

main()
