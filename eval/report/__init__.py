"""results.json and its pictures -> one HTML page: sentences in templates, figures from rows."""
