"""HTML pages of results.json and its pictures: templates have the sentences, rows the figures."""
