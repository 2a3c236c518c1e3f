"""The command, and ``python -m magfusion``."""


def run() -> None:
    """Run the command line; an interrupt while it is imported ends as one later does."""
    try:
        from magfusion.cli import main
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    main()


if __name__ == "__main__":
    run()
