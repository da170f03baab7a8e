# rotorwatch with its web page, the PostgreSQL driver and a Dask client. Build: docker build -t rotorwatch .
# Packages are those of lock/image.txt, each checked by its hash.
FROM python:3.13-slim-bookworm AS build
WORKDIR /src
COPY lock/image.txt lock/image.txt
RUN python -m venv /opt/rotorwatch && \
    /opt/rotorwatch/bin/pip install --no-cache-dir --require-hashes --only-binary :all: -r lock/image.txt
COPY pyproject.toml README.md LICENSE CHANGELOG.md ./
COPY src src
RUN /opt/rotorwatch/bin/pip install --no-cache-dir --no-deps . && \
    /opt/rotorwatch/bin/rotorwatch --version

FROM python:3.13-slim-bookworm
COPY --from=build /opt/rotorwatch /opt/rotorwatch
RUN useradd --create-home --uid 10001 rotorwatch && \
    install -d -o rotorwatch -g rotorwatch /data
ENV PATH=/opt/rotorwatch/bin:$PATH \
    XDG_CACHE_HOME=/data/cache
USER 10001
WORKDIR /data
VOLUME /data
EXPOSE 8000
ENTRYPOINT ["rotorwatch"]
CMD ["--help"]
