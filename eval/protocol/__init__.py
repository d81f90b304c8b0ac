"""Folders for comparisons of methods: suites of scenes, and methods' pictures of them."""
