"""What runs methods: the record loop, batches, online filters, checkpoints, gradients, blocks and results."""
