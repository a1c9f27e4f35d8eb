"""The report about a dataset: its verdict, advice for more photos, and a page."""
