"""The folders that methods are compared by: suites of scenes, and pictures that methods made of them."""
