"""The curriculum (tron-train): trains a neural renderer on guidance and pictures read from shards."""
