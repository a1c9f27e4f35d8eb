"""Training within a given time: a plan before it starts, and its pace while it runs."""
