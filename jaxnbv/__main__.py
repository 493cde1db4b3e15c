"""Entry point of `python -m jaxnbv`, which is the same as the command `jaxnbv`."""

from jaxnbv.cli import main

if __name__ == "__main__":
    main()
