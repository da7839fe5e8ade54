"""What docs print: the paper repeated, the Silverbox protocol, and the policies that ship."""
