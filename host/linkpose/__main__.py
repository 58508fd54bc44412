"""The program `linkpose`, and `python -m linkpose`."""

import signal


def main() -> None:
    """Entry point. Ctrl-C while the modules are imported ends the program at once, without a traceback."""
    handler = signal.getsignal(signal.SIGINT)
    is_pythons = handler is signal.default_int_handler  # it is another one under nohup and behind & in a script
    if is_pythons:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from linkpose.cli import main as run

    if is_pythons:
        signal.signal(signal.SIGINT, handler)
    run()


if __name__ == "__main__":
    main()
