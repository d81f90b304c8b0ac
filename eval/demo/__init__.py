"""The demo benchmark."""
