"""Runs the command `jaxnbv` as `python -m jaxnbv`."""

from jaxnbv.cli import main

if __name__ == "__main__":
    main()
