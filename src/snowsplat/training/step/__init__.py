"""What one step of a training is made of: the views, their gradients, the update."""
