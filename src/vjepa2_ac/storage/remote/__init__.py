"""Remote storage: `ranged_reads` and `uploads` over networks that fail, with the policy of `retries`."""
