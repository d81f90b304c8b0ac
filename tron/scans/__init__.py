"""Opening a file of splats: everything that happens before a scan is lit, for commands and Python alike."""

from tron.scans.scan import Scan

__all__ = ["Scan"]
