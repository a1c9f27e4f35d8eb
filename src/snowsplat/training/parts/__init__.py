"""What takes part in a training besides the loop, one option per file; see `part.Part`."""
