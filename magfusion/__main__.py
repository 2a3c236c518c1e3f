"""``python -m magfusion``."""

from magfusion.cli import main

main()
