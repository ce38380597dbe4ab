# docker build -t vislam .
# docker run --rm -v "$PWD:/data" -v vislam-compiled:/var/cache/vislam vislam run RECORDING --out runs/one
FROM debian:trixie-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends python3-venv
WORKDIR /source
COPY pyproject.toml hatch_build.py requirements.lock README.md LICENSE ./
COPY vislam vislam
# Versions are the lock's, and packages of tests stay out. Wheels are built elsewhere: nothing here compiles C.
RUN sed -n '/==/s/ *\\$//p' requirements.lock >pinned.txt && python3 -m venv /opt/vislam && \
    /opt/vislam/bin/pip install --no-cache-dir --only-binary :all: -c pinned.txt hatchling && \
    /opt/vislam/bin/pip install --no-cache-dir --no-build-isolation -c pinned.txt '.[all,mavlink]'

FROM debian:trixie-slim
# What Open3D's wheel loads from the system.
RUN apt-get update && apt-get install -y --no-install-recommends python3 libegl1 libgl1 libgomp1 libidn2-0 libx11-6 && \
    rm -rf /var/lib/apt/lists/* && useradd vislam && \
    install -d -o vislam -g vislam -m 0700 /var/cache/vislam && install -d -o vislam -g vislam /data
COPY --from=build /opt/vislam /opt/vislam
ENV PATH=/opt/vislam/bin:$PATH NUMBA_CACHE_DIR=/var/cache/vislam
USER vislam
WORKDIR /data
VOLUME /var/cache/vislam
ENTRYPOINT ["vislam"]
CMD ["--help"]
