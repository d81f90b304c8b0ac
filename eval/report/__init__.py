"""One self-contained HTML page for a benchmark: blocks of content, and the template that sets them."""
