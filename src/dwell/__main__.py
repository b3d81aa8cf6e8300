"""``python -m dwell``."""

from dwell.cli import main

if __name__ == "__main__":
    main()
