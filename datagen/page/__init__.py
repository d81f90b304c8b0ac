"""index.html of a dataset: a page of one file that filters, sorts and zooms clips without any network."""
