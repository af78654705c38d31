#!/bin/sh
# Flies PX4's SIH in a container past a pillar: sh examples/px4/fly.sh (Linux with Docker; pip install 'splatpilot[px4]')
set -e
cd "$(dirname "$0")"
docker compose up --detach
trap 'kill $link; docker compose down' EXIT
splatpilot hardware px4 --engage --arm &
link=$!
splatpilot hardware bridge --scenario scenario.yaml --hardware hardware.yaml --log flight.lcm --overwrite
