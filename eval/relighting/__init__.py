"""The relighting benchmark."""
