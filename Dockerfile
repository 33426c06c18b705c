# syntax=docker/dockerfile:1
# The driver with weights, scenes and configurations, for clusters and for machines without Rust:
#
#   docker build --tag gump --build-arg GUMP_COMMIT="$(git rev-parse HEAD)" .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/data" gump simulate \
#       --scenario FILE#0 --world model:/opt/gump/datasets/weights/gump-relative.safetensors --out futures
#
# Needs BuildKit, for the caches. The chapter "Install" of the guide has more.

# The oldest Rust that the workspace promises; a newer one may be named.
ARG RUST=1.91
# Built and run on the same release, so that the C library is the same.
ARG DEBIAN=bookworm

FROM rust:${RUST}-slim-${DEBIAN} AS build
WORKDIR /src
COPY . .
# There is no git to ask in the image.
ARG GUMP_COMMIT=unknown
# Crates and what was compiled last stay in caches of the builder, which are not part of the image:
# what is handed on leaves the cache within the same step.
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/src/target \
    GUMP_COMMIT="${GUMP_COMMIT}" cargo build --release --locked -p xtask --features grpc \
    && mkdir -p /opt/gump \
    && install -m 755 target/release/xtask /opt/gump/gump \
    && .ci/licences -p xtask --features grpc > /opt/gump/THIRD-PARTY.txt \
    && cp -r LICENSE NOTICE CHANGELOG.md configs datasets /opt/gump

FROM debian:${DEBIAN}-slim
LABEL org.opencontainers.image.title="gump" \
      org.opencontainers.image.description="A generative world model for driving" \
      org.opencontainers.image.licenses="Apache-2.0"
COPY --from=build /opt/gump /opt/gump
# What .cargo/config.toml sets. The driver would set them itself by starting over; here it need not.
ENV PATH=/opt/gump:$PATH \
    GUMP_HOME=/opt/gump \
    CANDLE_NUM_THREADS=1 \
    MIMALLOC_PURGE_DELAY=-1
# Nobody: who mounts a folder to write into names its owner with --user.
USER 65532:65532
# Relative paths on the command line are seen from here, results too.
WORKDIR /data
ENTRYPOINT ["gump"]
CMD ["--help"]
