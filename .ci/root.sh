# install PACKAGES REASON: with apt-get, as root or through sudo without a password; otherwise say what to type.
install() {
    packages=$1
    if command -v apt-get >/dev/null; then
        if [ "$(id -u)" -eq 0 ]; then
            run=
        elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
            run=sudo
        else
            run=no
        fi
        if [ "$run" != no ]; then
            echo "installing $packages $2"
            $run apt-get update -qq
            # shellcheck disable=SC2086
            DEBIAN_FRONTEND=noninteractive $run apt-get install -y -qq --no-install-recommends $packages >/dev/null
            return
        fi
    fi
    echo "These packages are needed $2 and could not be installed from here. Type:" >&2
    echo "    sudo apt-get install $packages" >&2
    exit 1
}
