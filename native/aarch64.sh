#!/bin/sh
# Builds the native module for aarch64 and runs the tests of its kernels on it, under qemu's
# emulation of that processor, with Debian's Python and PyPI's packages for it. On Debian, or a
# system with the keys of its archive, as any user:
#
#     apt-get install g++-aarch64-linux-gnu qemu-user-static
#     native/aarch64.sh [python] [test files]
#
# Downloads and builds stay in build/aarch64. Emulation is slow: imports take minutes.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
python=${1:-$root/.venv/bin/python}
[ $# -gt 0 ] && shift
python=$(cd "$(dirname "$python")" && pwd)/$(basename "$python")
work=$root/build/aarch64
for tool in aarch64-linux-gnu-g++ qemu-aarch64-static apt-get cmake; do
  command -v $tool > /dev/null || {
    echo "$tool is not installed; apt-get install g++-aarch64-linux-gnu qemu-user-static cmake" >&2
    exit 1
  }
done

# Debian's Python for the emulated machine, unpacked but not installed, by a separate apt that knows
# only the packages of that processor.
if [ ! -e "$work/system/usr/bin/python3.13" ]; then
  apt=$work/apt
  mkdir -p "$apt/etc/preferences.d" "$apt/state/lists/partial" "$apt/cache/archives/partial"
  : > "$apt/state/status"
  mirror=$(apt-get indextargets --format '$(SITE)' 'Created-By: Packages' | grep -m 1 /debian)
  echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $mirror trixie main" \
    > "$apt/etc/sources.list"
  set_apart="-o Dir::Etc=$apt/etc -o Dir::State=$apt/state -o Dir::State::status=$apt/state/status
    -o Dir::Cache=$apt/cache -o APT::Architecture=arm64 -o APT::Architectures=arm64"
  apt-get $set_apart --quiet update
  apt-get $set_apart --quiet --yes --no-install-recommends --download-only \
    install python3.13 libpython3.13-dev libglib2.0-0t64 libgomp1 libstdc++6
  mkdir -p "$work/system/usr/lib"
  ln -sfn usr/lib "$work/system/lib"
  for package in "$apt"/cache/archives/*.deb; do dpkg-deb --extract "$package" "$work/system"; done
fi

# Packages of the tests. Later versions of PyTorch need CUDA there.
if [ ! -e "$work/site/torch" ]; then
  "$python" -m uv pip install --quiet --target "$work/site" --only-binary :all: \
    --python-platform aarch64-manylinux_2_40 --python-version 3.13 \
    av drake edt hypothesis joblib lazy-loader lcm matplotlib numpy opencv-python-headless pillow \
    plyfile pytest pyyaml scipy torch==2.8.0 tqdm trimesh
fi

mkdir -p "$work/package/splatpilot"
for part in "$root"/splatpilot/*; do
  ln -sfn "$part" "$work/package/splatpilot/$(basename "$part")"
done
cat > "$work/python" <<END
#!/bin/sh
PYTHONPATH=$work/package:$work/site exec qemu-aarch64-static -L $work/system \
  $work/system/usr/bin/python3.13 "\$@"
END
chmod +x "$work/python"

cmake -S "$root" -B "$work/build" -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 \
  -DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++ -DCMAKE_CXX_FLAGS="-idirafter $work/system/usr/include" \
  -DPython_EXECUTABLE="$work/python" -DPython_INCLUDE_DIR="$work/system/usr/include/python3.13" \
  -DCMAKE_LIBRARY_OUTPUT_DIRECTORY="$work/package/splatpilot" \
  -Dnanobind_DIR="$("$python" -m nanobind --cmake_dir)"
cmake --build "$work/build" --parallel "$(nproc)"

cd "$root"
[ $# -gt 0 ] || set -- $(cat native/kernel_tests.txt)
"$work/python" -m pytest -q -p no:cacheprovider "$@"
echo "aarch64: every test passed"
