"""``python -m fieldtool``."""

from fieldtool.cli import main

if __name__ == "__main__":
    main()
