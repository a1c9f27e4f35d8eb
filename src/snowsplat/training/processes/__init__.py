"""The Gaussians of a training, distributed over processes; see `shards.Shards`."""
