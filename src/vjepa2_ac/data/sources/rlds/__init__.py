"""RLDS data sets: TFRecord shards as TFDS writes them."""
