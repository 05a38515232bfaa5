"""The interactive page of `vjepa2-ac explore`, which shows a model's predictions for commanded motions."""
