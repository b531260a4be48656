"""`python -m retwin` is the command line."""

from retwin.cli import main

if __name__ == "__main__":
    main()
