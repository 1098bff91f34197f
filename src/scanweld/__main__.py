"""`python -m scanweld`."""

from scanweld.cli import main

if __name__ == "__main__":
    main()
