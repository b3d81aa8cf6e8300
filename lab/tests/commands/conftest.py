"""What tests of commands share."""

from tests.cli.conftest import cell

__all__ = ["cell"]
