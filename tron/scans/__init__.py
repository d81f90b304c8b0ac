"""What a file of splats becomes before it is lit: one home for it, which commands and Python share."""

from tron.scans.scan import Scan

__all__ = ["Scan"]
