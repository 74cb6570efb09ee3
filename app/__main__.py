"""`python -m app` is `vesselflow`."""

from app.cli import main

if __name__ == "__main__":
    main()
