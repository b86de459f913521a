"""``python -m service.api``: the API process, as the supervisor starts it."""

from service.api.serve import serve
from service.settings import Settings

if __name__ == "__main__":
    serve(Settings())
