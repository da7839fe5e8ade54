"""What docs print: the paper repeated, the Silverbox protocol, rewards compared, and the policies that ship."""
