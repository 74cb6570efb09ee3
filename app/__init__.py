"""The program: command line, runs, recordings, control, studies."""


def version() -> str:
    """Version of the installed program."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed

    try:
        return installed("vesselflow")
    except PackageNotFoundError:
        return "not installed"
