"""What lies in a dataset's folder: records, card, previews, tables."""
