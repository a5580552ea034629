"""`python -m looktwice.service.cli` is `looktwice`."""

from looktwice.service.cli import main

main()
