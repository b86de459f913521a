"""Make the environments of all peers."""

from benchmarks.peers import PEERS, prepare

for peer in PEERS:
    print(f"{peer}: {prepare(peer)}")
