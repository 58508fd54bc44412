"""A page in the browser that shows a link or a robot in 3-D while it is measured, or from a file."""

from linkpose.page.page import Page, free_port
from linkpose.page.status import PageStatus

__all__ = ["Page", "PageStatus", "free_port"]
