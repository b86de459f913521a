"""``python -m service``: the command line."""

from service.cli import app

if __name__ == "__main__":
    app()
