"""The files of a dataset: which there are, which of them are masks, and which a name means."""
