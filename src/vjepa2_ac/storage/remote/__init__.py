"""Remote storage: reading, and the calls behind writing, over networks that fail, with the policy of `retries`."""
