"""Pages of pictures, tables and films as one HTML file: what benchmarks and reconstructions report with."""
