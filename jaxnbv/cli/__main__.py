"""`python -m jaxnbv.cli`."""

from jaxnbv.cli import main

if __name__ == "__main__":
    main()
