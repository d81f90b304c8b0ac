"""The curriculum (tron-train): guidance and pictures from shards in, a neural renderer's weights out."""
