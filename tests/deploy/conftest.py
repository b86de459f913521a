"""The tests of the service have a PostgreSQL; these use one like it."""

from tests.service.conftest import postgres_server

__all__ = ["postgres_server"]
