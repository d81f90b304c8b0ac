"""Files of a dataset's folder: records, card, previews, tables."""
